"""Driving on highway-env's roads, among its traffic: `lpv_track_env/HighwayTrack-v0`.

============  ==========================================================================
module        contents
============  ==========================================================================
`scenes`      roads and traffic, by name or on the user's own network
`routes`      reference paths from routes over lanes
`cruise`      adaptive cruise control of the reference's speed
`traffic`     the ego vehicle among others, and the vehicles ahead of it
`env`         the environment
`wrapper`     this project's agents in highway-env's own environments
============  ==========================================================================

It needs highway-env: `pip install 'lpv-track-env[highway]'`.
"""

try:
    import highway_env  # noqa: F401  imported here for one clear error if it is missing
except ModuleNotFoundError as error:
    if error.name != "highway_env":
        raise
    raise ModuleNotFoundError(
        "highway-env is not installed: pip install 'lpv-track-env[highway]'", name="highway_env"
    ) from None
