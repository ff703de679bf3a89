"""Who may look at a page: whoever is at this machine, or has its token."""

from __future__ import annotations

import hmac
import ipaddress
import secrets
import socket
from dataclasses import dataclass
from urllib.parse import urlsplit


@dataclass(frozen=True, kw_only=True)
class Access:
    """Who may look: at an address that other machines reach, those who have the token."""

    host: str
    token: str
    """Empty where only this machine is served."""

    @classmethod
    def at(cls, host: str) -> Access:
        """Return what an address needs, with a new token where it is not of this machine alone."""
        return cls(host=host, token="" if _is_loopback(host) else secrets.token_urlsafe(16))

    def url(self, port: int) -> str:
        """Return the address to open, token included."""
        name = socket.gethostname() if self.host in ("0.0.0.0", "::") else self.host
        query = f"?token={self.token}" if self.token else ""
        return f"http://{f'[{name}]' if ':' in name else name}:{port}/{query}"

    def refuses_name(self, host_header: str) -> bool:
        """Return whether the name under which the page was asked for is not one of this machine's own.

        A foreign page can let its own name point here, and would then be allowed to read the answer. Where there is a
        token it has none.
        """
        if self.token:
            return False
        try:
            name = urlsplit(f"//{host_header}").hostname
        except ValueError:
            return True
        return name is None or not _is_loopback(name)

    def refuses_token(self, given: str) -> bool:
        """Return whether a token is needed and another was given; takes as long for any."""
        return bool(self.token) and not hmac.compare_digest(given.encode(), self.token.encode())


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
