"""Files from outside in, a verdict out: types, sizes and limits, judged without a decoder."""
