"""The mesh job: a scan becomes mesh files."""
