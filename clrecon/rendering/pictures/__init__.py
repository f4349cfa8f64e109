"""Pictures: their styles, annotations, files, and their place in scenes."""
