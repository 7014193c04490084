"""`lpv-track speed`: how fast the environments and the solvers are, as ratios within one run.

A section measures one thing and knows nothing of the others; `command.SECTIONS` lists them. Raw
rounds go to `speed.json`, from which tables and pictures are made.
"""
