"""ROS bags: export of a run, reference path from a recorded drive, replay.

`topics` holds plain arrays, `messages` converts them to ROS messages, `write` and `read` handle the
files (ROS 1 and ROS 2, through `rosbags`, without ROS). `runs` makes the topics of a simulated run,
`reference` makes a path from a drive, `replay` feeds recorded sensors to the estimator and an
agent, and `comparison` compares the result with the recording.
"""
