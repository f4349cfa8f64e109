"""Label maps: which voxel belongs to which structure, read from NIfTI, NRRD, DICOM SEG and RTSTRUCT."""

from clrecon.labels.label_map import LabelMap, file_suffixes, label_suffix
from clrecon.labels.reader import read_labels
from clrecon.labels.resample import ResampledLabels, resample_labels

__all__ = ["LabelMap", "ResampledLabels", "file_suffixes", "label_suffix", "read_labels", "resample_labels"]
