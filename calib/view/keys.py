"""Who may see the workbench and who may change anything: the keys in its address.

The server listens on this machine alone, but other people use this machine too, and any page that
a browser shows can send requests to it. So a request is let in only

- with a key, the first part of its path (a query would not reach the websocket, and a cookie would
  go to every other server on this machine); what follows in the path says what to show;
- addressed to this machine by name: a page whose own name was made to point here (DNS rebinding)
  has another name in `Host`;
- on the websocket, from the page that was served here: `Origin` is what `Host` says.
"""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from dataclasses import dataclass, field
from urllib.parse import urlsplit

LOCAL = ("127.0.0.1", "localhost")
KEY_BYTES = 32  # 256 bits: not to be guessed


@dataclass(frozen=True)
class Visit:
    """A request that was let in.

    Args:
        may_change: whether it may start a fit, or only look.
        asks: what stands after the key: what the page is to show, as `look` has it.
    """

    may_change: bool
    asks: str = ""


def _new_key() -> str:
    return secrets.token_urlsafe(KEY_BYTES)


@dataclass(frozen=True)
class Keys:
    """Two keys, made anew for each server.

    Args:
        change: of the address that may do everything.
        look: of the address that may only look.
    """

    change: str = field(default_factory=_new_key, repr=False)
    look: str = field(default_factory=_new_key, repr=False)

    def visit(
        self, target: str, hosts: Sequence[str], origins: Sequence[str], websocket: bool
    ) -> Visit | None:
        """What a request may do; None where it is to be refused.

        Args:
            target: path and query, as the request has them.
            hosts, origins: every `Host` and `Origin` header of it.
            websocket: whether it asks for one.
        """
        if len(hosts) != 1 or not _is_local(hosts[0]):
            return None
        if (websocket or origins) and list(origins) != [f"http://{hosts[0]}"]:
            return None
        key, _, rest = target.partition("?")[0].removeprefix("/").partition("/")
        given = key.encode("utf-8", "surrogateescape")
        # Both are compared, each in constant time.
        may_change, may_look = (
            secrets.compare_digest(given, known.encode()) for known in (self.change, self.look)
        )
        return Visit(may_change, rest) if may_change or may_look else None


def _is_local(host: str) -> bool:
    """Whether a `Host` header names this machine; any port, as a tunnel may have its own."""
    try:
        parts = urlsplit(f"//{host}")
        return (
            parts.hostname in LOCAL
            and parts.netloc == host
            and parts.port != 0
            and (parts.username is None)
        )
    except ValueError:
        return False
