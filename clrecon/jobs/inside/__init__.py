"""The job that looks into vertebrae: parts of the bone and the canal as meshes, with their volumes."""
