"""Python SDK, command line and dashboard. No torch at import."""
