"""The spine, vertebra by vertebra: a first guess of a label map from the scan alone, and corridors through pedicles."""

from __future__ import annotations

from clrecon.spine.split import Vertebra, VertebraSplit, split_vertebrae

__all__ = ["Vertebra", "VertebraSplit", "split_vertebrae"]
