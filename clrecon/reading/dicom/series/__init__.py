"""Series: files are grouped into series, and each gets its certificate."""
