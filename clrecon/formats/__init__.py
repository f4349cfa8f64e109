"""Files other than DICOM that hold a grid of numbers and an affine: NIfTI, NRRD and MetaImage."""

from clrecon.formats.grid_file import LABEL_MAP, VOLUME, GridFile
from clrecon.formats.kinds import open_grid, tell_kind
from clrecon.formats.reader import list_grid, read_grid

__all__ = ["LABEL_MAP", "VOLUME", "GridFile", "list_grid", "open_grid", "read_grid", "tell_kind"]
