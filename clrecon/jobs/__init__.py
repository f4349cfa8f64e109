"""The jobs: whole tasks from an input to a result, without printing and without command line.

Every job takes paths, a settings dataclass and an optional `progress`, and returns a plain dict that JSON can hold.
The submodules are imported one by one, so that a job brings only the libraries that it needs.
"""
