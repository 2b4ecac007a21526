"""The server's part of the `intrasplat` command, the Python client, and the web page. No torch at import."""
