"""Vertebrae one by one: a first guess of a label map from the scan alone."""

from clrecon.vertebrae.result import Vertebra, VertebraSplit
from clrecon.vertebrae.split import split_vertebrae

__all__ = ["Vertebra", "VertebraSplit", "split_vertebrae"]
