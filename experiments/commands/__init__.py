"""Commands of `lpv-track`, a module each, imported only when its command is called.

A command's module has `EXAMPLE`, a line to type; `add_options(parser)`, which declares its options;
and `run(options, console)`, which returns the exit code. Heavy imports stay inside `run`, so that
`--help` is quick. `experiments.cli.COMMANDS` lists the commands.
"""
