"""Many cameras, one person: Date, Yoshimatsu, Arita and Taniguchi's way from pictures to a pose.

One camera's picture: `regions` (the person), `skin_blobs`, `contours` (the registered pose) and
`faces` (where the face looks). All cameras: `rays` and `features` (3-D points of head, hands and
feet). The pose: `skeleton`, `inverse_kinematics`, `limb_search`, `paper_pose`. `recognition` mends
a lost track, `capture` goes through it all frame by frame. Plain functions on arrays.
"""
