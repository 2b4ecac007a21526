"""Internet addresses that this machine may connect to on behalf of a user."""

from __future__ import annotations

from ipaddress import IPv4Address, IPv6Address, IPv6Network, ip_address

NAT64 = IPv6Network("64:ff9b::/96")
METADATA = frozenset(map(ip_address, ("fd00:ec2::254", "fd20:ce::254", "fd00:c1::a9fe:a9fe")))
"""Metadata servers of clouds, which give secrets to their machines; others have link-local addresses."""


def is_permitted(text: str, private: bool) -> bool:
    """Whether connections may go to an address; private: also to this machine and private networks."""
    address = _meant(ip_address(text.partition("%")[0]))
    if address.is_link_local or address.is_multicast or address.is_unspecified or address in METADATA:
        return False
    if address.is_reserved and not address.is_loopback:  # some map to an IPv4 address that is unknown here
        return False
    return address.is_global or (private and (address.is_private or address.is_loopback))


def _meant(address: IPv4Address | IPv6Address) -> IPv4Address | IPv6Address:
    """The IPv4 address that an IPv6 address embeds; any other address unchanged."""
    if isinstance(address, IPv4Address):
        return address
    if address in NAT64:
        return IPv4Address(int(address) & 0xFFFFFFFF)
    return address.ipv4_mapped or address.sixtofour or address
