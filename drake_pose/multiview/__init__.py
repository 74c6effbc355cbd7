"""Many cameras, one person: Date, Yoshimatsu, Arita and Taniguchi's way from pictures to a pose.

One camera's picture: `regions` (the person), `skin_blobs`, `contours` (the registered pose) and
`faces` (where the face looks). All cameras: `rays` and `features` (3-D points of head, hands and
feet). The pose: `skeleton`, `inverse_kinematics`, `limb_search`, `paper_pose`. `recognition` mends
a lost track. `capture` holds what must be known beforehand, and one camera's share;
`learned_files` and `recorded_faces` keep and learn backgrounds and faces. Plain functions on
arrays, wired as stages in `systems/paper_capture.py`.

What recordings suffer from: `figures` and `other_persons` (others in view), `person_recording`
(nobody in view), `rig_faults` with `hull` (mirrored or exchanged cameras), `camera_faults` (a
camera that moved). `checked_capture` captures a recording in spite of them, and says which.
"""
