"""Public functions of clrecon by their names, for methods of classes that stand left of them.

`Volume.save` is `clrecon.write_volume`, and the writers of files know volumes: an import in the class would lead round
a corner.  The list of the public names, `clrecon/__init__.pyi`, knows where both are.  The guard of the layers lists
the modules that call this one.
"""

from __future__ import annotations

import sys
from typing import Any


def public_function(name: str) -> Any:
    """Return a public function, ``clrecon.NAME``; its module is imported when it is first asked for."""
    return getattr(sys.modules["clrecon"], name)
