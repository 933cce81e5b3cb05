"""The command line: arguments in, exit codes out; one module per sub-command, imported when it is called."""
