"""Choosing the NMPC's weights while it drives: what is watched, environments, policies, an agent.

`features` says what a chooser sees, `env` and `vector_env` are `lpv_track_env/WeightTuning-v0`,
`policy` is what was learned there, `files` its files, `agent` drives with it.
"""
