"""Reading of DICOM: CT images, single slices or multi-frame, become a `clrecon.geometry.Volume` in HU and LPS mm."""

from clrecon.reading.common.source_facts import SeriesEntry, SeriesListing
from clrecon.reading.dicom.reader import list_series, read_volume

__all__ = ["SeriesEntry", "SeriesListing", "list_series", "read_volume"]
