"""The job that measures how far two meshes lie apart: figures, a coloured mesh, a picture."""
