"""Reading of DICOM: CT images, single slices or multi-frame, become a `clrecon.geometry.Volume` in HU and LPS mm."""

from clrecon.dicom.reader import list_series, read_volume
from clrecon.sources.listing import SeriesEntry, SeriesListing

__all__ = ["SeriesEntry", "SeriesListing", "list_series", "read_volume"]
