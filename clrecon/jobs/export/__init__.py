"""The export job: a CT series in, its volume out as NIfTI, NRRD or MetaImage."""
