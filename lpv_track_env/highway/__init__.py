"""Driving on highway-env's roads, among its traffic: `lpv_track_env/HighwayTrack-v0`.

============  ==========================================================================
module        what it holds
============  ==========================================================================
`scenes`      roads by name, or the user's own network; who drives there
`routes`      a reference path from a route over lanes
`ego`         this project's plant as a vehicle of highway-env
`cruise`      adaptive cruise control of the speed reference
`env`         the environment
============  ==========================================================================

It needs highway-env: `pip install 'lpv-track-env[highway]'`.
"""

try:
    import highway_env  # noqa: F401  asked for here, once, so that its lack is told in one line
except ModuleNotFoundError as error:
    if error.name != "highway_env":
        raise
    raise ModuleNotFoundError(
        "highway-env is not installed: pip install 'lpv-track-env[highway]'", name="highway_env"
    ) from None
