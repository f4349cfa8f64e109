"""Reading of DICOM: CT images, single slices or multi-frame, become a `clrecon.geometry.Volume` in HU and LPS mm."""
