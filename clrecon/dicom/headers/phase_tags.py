"""Elements that distinguish the phases of one series: several volumes at one place."""

from __future__ import annotations

FRAME_PHASES = (
    ("TemporalPositionIndex", 0x00209128, "L"),
    ("TemporalPositionTimeOffset", 0x0020930D, "d"),
    ("NominalPercentageOfCardiacPhase", 0x00209241, "f"),
    ("NominalCardiacTriggerDelayTime", 0x00209153, "d"),
    ("NominalPercentageOfRespiratoryPhase", 0x00209245, "f"),
    ("NominalRespiratoryTriggerDelayTime", 0x00209255, "d"),
    ("StackID", 0x00209056, ""),
    ("FrameAcquisitionNumber", 0x00209156, "H"),
)
"""Elements of functional groups that distinguish frames at the same place, the most specific first; "" marks text."""

SLICE_PHASES = (
    "TemporalPositionIdentifier",
    "TriggerTime",
    "AcquisitionNumber",
    "AcquisitionDate",
    "AcquisitionTime",
    "KVP",
    "ConvolutionKernel",
    "ImageType",
    "ContentDate",
    "ContentTime",
)
PHASE_KEYWORDS = (*(keyword for keyword, _, _ in FRAME_PHASES), *SLICE_PHASES)
"""Elements that distinguish the phases of a series, the most specific first: those of frames, then of slices."""
