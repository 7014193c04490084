"""ROS bags: export of a run, import, a reference path from a recorded drive, replay.

`topics` has what is exchanged as plain arrays, `messages` its ROS messages, `write` and `read` the
files (ROS 1 and ROS 2, through `rosbags`, which needs no ROS), `runs` makes topics of a run,
`sensors` adds errors, `reference` makes a path of a drive, `recording` and `replay` feed recorded
sensors to the estimator and an agent, `comparison` reports on it.
"""
