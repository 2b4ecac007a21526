"""HTTP: parse, one call, return. No torch."""
