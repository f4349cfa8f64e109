"""The render job: a scan becomes picture files."""
