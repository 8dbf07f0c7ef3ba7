"""Addresses of TCP servers as they are written: an IPv6 host stands in brackets."""

from __future__ import annotations


def host_port(host: str, port: int) -> str:
    """`127.0.0.1:80` or `[::1]:80`."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
