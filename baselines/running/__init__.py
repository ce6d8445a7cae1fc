"""Running a command: worker processes, stopping by signals, and files that are not finished yet."""
