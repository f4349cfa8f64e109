"""The version of the installed package."""

from __future__ import annotations


def package_version() -> str:
    """Version as it was installed; ``0+uninstalled`` for a source folder that nobody has installed."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("clrecon")
    except PackageNotFoundError:
        return "0+uninstalled"
