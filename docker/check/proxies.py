"""nginx and Caddy as docs/operations.md has them, on a free port, with a certificate that is made here."""

from __future__ import annotations

import os
import re
import socket
import ssl
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

PAGE = Path(__file__).resolve().parent.parent.parent / "docs" / "operations.md"
DOCUMENTED_NAME = "splat.example.org"
START_TIMEOUT_S = 20.0

NGINX = """
daemon off; worker_processes 1; pid {folder}/pid; error_log stderr warn;
events {{}}
http {{
  access_log off;
  client_body_temp_path {folder}/body; proxy_temp_path {folder}/proxy;
  fastcgi_temp_path {folder}/fastcgi; uwsgi_temp_path {folder}/uwsgi; scgi_temp_path {folder}/scgi;
  {documented}
}}
"""
CADDY = """
{{
  admin off
  auto_https disable_redirects
  storage file_system {folder}
}}
{documented}
"""


@dataclass(frozen=True)
class Site:
    """Where a proxy answers: a name and its address, a port, and a folder with cert.pem and key.pem for the name."""

    name: str
    address: str
    port: int
    folder: Path

    @property
    def url(self) -> str:
        """What callers are told."""
        return f"https://{self.name}:{self.port}"


def site_in(folder: Path) -> Site:
    """A site by this machine's own name, or by `localhost` if that is no address of its own."""
    name = socket.gethostname()
    try:
        address = socket.gethostbyname(name)
    except OSError:
        name, address = "localhost", "127.0.0.1"
    with socket.socket() as probe:
        probe.bind((address, 0))
        port = probe.getsockname()[1]
    command = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    command += ["-days", "1", "-subj", f"/CN={name}", "-addext", f"subjectAltName=DNS:{name}"]
    command += ["-keyout", str(folder / "key.pem"), "-out", str(folder / "cert.pem")]
    subprocess.run(command, check=True, capture_output=True)
    return Site(name, address, port, folder)


def documented(language: str) -> str:
    """The page's block for this proxy."""
    (block,) = re.findall(rf"^```{language}\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    return str(block)


def nginx_config(site: Site) -> str:
    """The documented server for this site, with what every nginx needs around it."""
    server = documented("nginx").replace("listen 443", f"listen {site.address}:{site.port}")
    server = server.replace("/etc/ssl/splat.pem", f"{site.folder}/cert.pem")
    server = server.replace("/etc/ssl/splat.key", f"{site.folder}/key.pem").replace(DOCUMENTED_NAME, site.name)
    return NGINX.format(folder=site.folder, documented=server)


def caddy_config(site: Site) -> str:
    """The documented site for this one; a certificate is given, for nobody outside would sign one."""
    first = f"{site.url} {{\n  bind {site.address}\n  tls {site.folder}/cert.pem {site.folder}/key.pem"
    return CADDY.format(folder=site.folder, documented=documented("caddy").replace(f"{DOCUMENTED_NAME} {{", first))


@contextmanager
def proxy(program: str, site: Site) -> Iterator[None]:
    """The proxy (`nginx` or `caddy`), from when it answers until the context ends."""
    file = site.folder / program
    file.write_text(nginx_config(site) if program == "nginx" else caddy_config(site), encoding="utf-8")
    command = ["nginx", "-e", "stderr", "-p", str(site.folder), "-c", str(file)]
    if program == "caddy":
        command = ["caddy", "run", "--adapter", "caddyfile", "--config", str(file)]
    homes = {"XDG_CONFIG_HOME": str(site.folder), "XDG_DATA_HOME": str(site.folder)}  # Caddy keeps what it was told
    with (
        (site.folder / f"{program}.log").open("wb") as log,
        subprocess.Popen(command, stderr=log, stdout=log, env={**os.environ, **homes}) as server,
    ):
        try:
            deadline_s = time.monotonic() + START_TIMEOUT_S
            while not _answers(site):
                if server.poll() is not None or time.monotonic() > deadline_s:
                    raise RuntimeError(f"{program} does not start:\n{(site.folder / f'{program}.log').read_text()}")
                time.sleep(0.05)
            yield
        finally:
            server.terminate()


def protocol(site: Site) -> str:
    """What TLS agrees on with a browser: `h2` or `http/1.1`."""
    context = ssl.create_default_context(cafile=str(site.folder / "cert.pem"))
    context.set_alpn_protocols(["h2", "http/1.1"])
    with (
        socket.create_connection((site.address, site.port)) as plain,
        context.wrap_socket(plain, server_hostname=site.name) as connection,
    ):
        return connection.selected_alpn_protocol() or "none"


def _answers(site: Site) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((site.address, site.port)) == 0
