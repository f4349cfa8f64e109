"""The jobs: whole tasks from paths and settings to files and a report.  Submodules are imported one by one."""
