"""The methods: everything that decides how a clip is trained, as data. Each file reads from the first point to the end.

Read in this order: method (what a preset says, and what a departure is), paper (the published method), fast (ours: what
it does otherwise than paper), registry (a preset by its name). docs/method.md has the same in one page, with figures.
"""
