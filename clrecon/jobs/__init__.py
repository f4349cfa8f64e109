"""The jobs: whole tasks from paths and settings to files and a report, without printing and without command line.

The submodules are imported one by one, so that a job brings only the libraries that it needs.
"""
