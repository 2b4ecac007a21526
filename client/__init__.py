"""The `intrasplat` command, the demo, and the page for the browser. No torch at import."""
