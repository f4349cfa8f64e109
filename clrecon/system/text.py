"""Text from files, made safe to print: file names and DICOM text fields are written by strangers."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable
from functools import lru_cache

_TEXT_LIMIT = 64
_NAMES_SHOWN = 5
_MOST_PLACES = 12
_LARGEST_HU, _LARGEST_WRITTEN = 1e6, 1e15


def escape_text(text: str, limit: int = _TEXT_LIMIT) -> str:
    r"""Return `text` in one printable line of at most `limit` characters, others as ``\xNN`` or ``\uNNNN``."""
    if text.isprintable() and len(text) <= limit:
        return text
    safe = "".join(c if c.isprintable() else escape_character(c) for c in text)
    return safe if len(safe) <= limit else safe[: limit - 3] + "..."


def escape_character(character: str) -> str:
    r"""Return the code of a character; of a byte of a file name that is no letter in this locale, ``\xNN``."""
    code = ord(character)
    return f"\\x{code & 0xFF:02x}" if 0xDC80 <= code <= 0xDCFF else character.encode("unicode_escape").decode("ascii")


def guess_word(word: object, known: Iterable[str]) -> str:
    """Return `` (did you mean X?)`` with the known word that is most like `word` in any case; empty if none is."""
    if not isinstance(word, str) or len(word) > _TEXT_LIMIT:
        return ""
    from difflib import get_close_matches  # only where something was misspelt

    folded = {name.casefold(): name for name in known}
    near = get_close_matches(word.casefold(), folded, n=1)
    return f" (did you mean {folded[near[0]]}?)" if near else ""


def unknown_name(noun: str, word: object, known: Iterable[str]) -> str:
    """Return the start of a message: the word is unknown, which one it may have meant, and all that are known."""
    known = list(known)
    return f"unknown {noun} {word!r:.60}{guess_word(word, known)}: use one of {', '.join(known)}"


def count_of(number: int, noun: str, several: str | None = None) -> str:
    """Return a count with its noun: ``1 slice``, ``1,200 slices``; `several` is the plural if it is not noun + s."""
    return f"{number:,} {noun if number == 1 else several or noun + 's'}"


def format_bytes(size: float) -> str:
    """Format a number of bytes for people: ``12.3 MB`` (1 MB = 10^6 bytes)."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size >= factor:
            return f"{size / factor:,.1f} {unit}"
    return f"{size:.0f} bytes"


def format_digits(value: float, digits: int = 3) -> str:
    """Return a number with so many significant digits, never an exponent: ``12,346`` whole, ``0.0039``, ``-312``."""
    if value == 0.0:
        return "0"
    if not math.isfinite(value) or abs(value) >= _LARGEST_WRITTEN:
        return f"{value:g}"
    places = min(max(0, digits - 1 - math.floor(math.log10(abs(value)))), _MOST_PLACES)
    text = f"{value:,.{places}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def format_hu(value: float) -> str:
    """Return HU as far as they mean something: whole numbers as they are, others with three significant digits."""
    if math.isfinite(value) and value == round(value) and abs(value) < _LARGEST_HU:
        return str(round(value))
    return format_digits(value)


def format_ml(ml: float, digits: int = 3) -> str:
    """Return a volume with its unit: ml, and mm3 below 0.1 ml."""
    return (
        f"{format_digits(ml, digits)} ml"
        if abs(ml) >= 0.1 or ml == 0.0
        else f"{format_digits(1000.0 * ml, digits)} mm3"
    )


def format_volume(ml: float) -> str:
    """Return a measured volume with its unit: ml to two decimals, and mm3 below 0.1 ml."""
    return f"{ml:,.2f} ml" if abs(ml) >= 0.1 else format_ml(ml)


def format_band(low: float, high: float, unit: str = "HU") -> str:
    """Return what lies from `low` to `high`, an infinite end open: ``200 HU and more``, ``up to 40 HU``."""
    if math.isinf(low):
        return f"any {unit}" if math.isinf(high) else f"up to {high:g} {unit}"
    return f"{low:g} {unit} and more" if math.isinf(high) else f"{low:g} to {high:g} {unit}"


def is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def format_share(share: float, places: int = 0) -> str:
    """Return a share, 0 to 1, as ``31 %``, with so many digits behind the point."""
    return f"{100.0 * share:.{places}f} %"


@lru_cache(1024)
def hash_uid(uid: str) -> str | None:
    """Return the first 16 hexadecimal digits of the SHA-256 of a UID, which do not reveal it; None for an empty one."""
    if not uid:
        return None
    return hashlib.sha256(uid.encode("utf-8", "replace")).hexdigest()[:16]


def join_names(names: Iterable[object], most: int = _NAMES_SHOWN) -> str:
    """Join the first few names for a message, then a count; only the names that are shown are converted to text."""
    names = list(names)
    shown = ", ".join(map(str, names[:most]))
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def list_names(names: Iterable[str]) -> str:
    """List all names in words: ``a``, ``a and b``, ``a, b and c``; empty without any."""
    *first, last = list(names) or [""]
    return " and ".join(filter(None, (", ".join(first), last)))


def to_hexadecimal(rgb: Iterable[float]) -> str:
    """Return a colour of red, green and blue, 0 to 1, as ``#rrggbb``."""
    return "#" + "".join(f"{round(255 * min(max(float(share), 0.0), 1.0)):02x}" for share in rgb)
