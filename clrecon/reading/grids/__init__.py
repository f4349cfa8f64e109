"""Files other than DICOM that hold a grid of numbers and an affine: NIfTI, NRRD and MetaImage."""

from clrecon.reading.grids.grid_file import LABEL_MAP, VOLUME, GridFile
from clrecon.reading.grids.reader import list_grid, open_grid, read_grid, tell_kind

__all__ = ["LABEL_MAP", "VOLUME", "GridFile", "list_grid", "open_grid", "read_grid", "tell_kind"]
