"""A transfer function without steps."""

from __future__ import annotations

from clrecon.rendering import TransferFunction

SOFT = TransferFunction([(-300, 0.9, 0.2, 0.1, 0.0), (200, 1, 0.7, 0.4, 0.15), (900, 1, 1, 0.9, 0.6)])
