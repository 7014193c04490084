"""Choice of the NMPC's weights while it drives: features, environments, policies, an agent.

`features` defines what weights are chosen on, `env` and `vector_env` are the environment
`lpv_track_env/WeightTuning-v0`, `policy` has the policies learned there, `agent` drives with one.
"""
