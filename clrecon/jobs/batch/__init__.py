"""The batch job: many scans of one manifest, each made once and whole, with a table and a page of all."""
