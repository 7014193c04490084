"""lpv_track_env."""
