"""Many cameras, one person.

`date`: the stages of Date, Yoshimatsu, Arita and Taniguchi, from pictures to a pose. `person`: one
person from all silhouettes at once. `recordings`: whole recordings, in spite of others in view,
nobody in view (`person_recording`), mirrored or exchanged cameras (`rig_faults`) and cameras that
moved (`camera_faults`). All begin with `regions`, the person in one camera's picture, and `rays`.
Plain functions on arrays; Drake's systems of them are in `systems`.
"""
