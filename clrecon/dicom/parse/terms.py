"""Defined terms of the standard: only these go into warnings and reports, never other contents of a field."""

from __future__ import annotations

RESCALE_TYPES = frozenset("HU HU_MOD OD US MGML Z_EFF ED EDW PCT".split())
"""Defined terms of RescaleType (PS3.3 C.11.1.1.2)."""

MODALITIES = frozenset(
    """
    ANN AR AS ASMT AU BDUS BI BMD CD CF CFM CP CR CS CT CTPROTOCOL DD DF DG DM DMS DOC DS DX EC ECG EEG EMG EOG EPS ES
    FA FID FS GM HC HD IO IOL IVOCT IVUS KER KO LEN LP LS M3D MA MG MR MS NM OAM OCT OP OPM OPR OPT OPTBSV OPTENF OPV
    OSS OT PA PLAN POS PR PT PX REG RESP RF RG RTDOSE RTIMAGE RTINTENT RTPLAN RTRAD RTRECORD RTSEGANN RTSTRUCT RWV SEG
    SM SMR SR SRF ST STAIN TEXTUREMAP TG TH US VA VF VM XA XAPROTOCOL XC
    """.split()
)
"""Defined terms of Modality, with retired ones (PS3.3 C.7.3.1.1.1)."""

OTHER_TERM = "other"


def name_term(term: str, defined: frozenset[str]) -> str:
    """Return the term itself if it is defined or empty, else `OTHER_TERM`: free text could be a person's name."""
    return term if term in defined or not term else OTHER_TERM
