"""Date, Yoshimatsu, Arita and Taniguchi's way from the pictures of many cameras to a pose.

One camera's picture: `skin_blobs`, `contours` (the registered pose) and `faces` (where the face
looks). All cameras: `features` (3-D points of head, hands and feet). The pose: `skeleton`,
`inverse_kinematics`, `limb_search`, `body_pose`. `recognition` mends a lost track. `capture` holds
what must be known beforehand, and one camera's share; `learned_files` and `recorded_faces` keep
and learn backgrounds and faces. Wired as stages in `systems/date/capture.py`.
"""
