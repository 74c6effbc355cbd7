"""The commands' help: the ideas in a few lines, and examples that can be pasted."""

from __future__ import annotations


def _help(text: str) -> str:
    """Returns a text for rich: paragraphs are unfolded, indented examples stay line by line."""
    paragraphs = []
    for paragraph in text.strip().split("\n\n"):
        lines = paragraph.split("\n")
        is_example = lines[0].startswith("    ")
        paragraphs.append("\n".join(lines) if is_example else " ".join(lines))
    return "\n\n".join(paragraphs)


PROGRAM = _help("""
Joint angles of articulated objects from silhouettes.

Give the body as any model file that Drake reads (URDF, SDFormat, MJCF), and the pictures as a
scene: a folder with [bold]cameras.yaml[/bold] and black and white
[bold]masks/<camera>/<frame>.png[/bold]. No training, no graphics card. Begin with
[bold]drake-pose demo[/bold].

Exit status: 0 done, 1 failed (the message says what is at fault), 2 wrong usage.
""")

ESTIMATE = _help(r"""
Estimate the joint angles in every frame of a scene.

The body is placed segment by segment from the root outwards, in thousands of ways at once; those
that cover most of the silhouettes are drawn to their edges, at continuous angles. Holes, shadows
and what stands before the body may spoil the masks. Several cameras are matched together. --method
paper is the search of Kameda, Minoh and Ikeda as they published it.

Where scene.yaml says [bold]sequence: true[/bold], the body is searched in the first frame and
tracked by its contour from there, inside its limits; it is searched again when the track is lost.

A person before two calibrated cameras or more is followed by all silhouettes at once, lengths and
girths being fitted where the model has them, if the model has a person's landmarks and a root on
joints, as urdf/person/person_shape.urdf does, and no option concerns a search (--method person).

DIR gets report.html, which shows it all; poses.csv (a row a frame: every joint's position in rad or
m, E_total, seconds); joints.csv (which joints the silhouettes determine, and in what interval);
families.csv (poses that look the same); joint_centres.csv where landmarks.yaml lies beside the
model; of a sequence joint_centres.trc, positions.mot and motion.bvh; summary.json;
overlay/<camera>/<frame>.png to judge by; and replay.html. E_total is the area where body and
silhouette differ over the silhouette's area. Ctrl-C keeps the finished frames; --resume goes on.

[bold]A robot arm bolted to the world's origin, seen by two cameras:[/bold]

    drake-pose estimate ../shared/data/arm_two_views --out results/arm \
      --model ../shared/data/arm_two_views/med7/med7.urdf

[bold]A man who stands on a foot whose position is known, seen by one camera:[/bold]

    drake-pose estimate ../shared/data/human_four_views --out results/man \
      --model urdf/man/man.urdf --camera cam04 --frame 0:9 --root right_foot \
      --root-position ../shared/data/human_four_views/joint_centres.csv:right_ankle \
      --root-rotation y=-180:180,x=-20:20,z=-20:20
""")

DEMO = _help("""
Estimate a stored real picture: a man balancing on a beam, seen by one camera.

Only the position of his right ankle is known. The search begins at that foot and finds all other
joint angles, as Kameda, Minoh and Ikeda did for real people. The model is a man of average
measures, not made from this man.

[bold]Example:[/bold]

    drake-pose demo --out results/demo
""")

CHECK = _help("""
Say whether a model is fit for pose estimation, and if not, why.

A fit model has visual geometry to be seen, and limits on every joint that could otherwise go on for
ever. Shown are the segments of the pose tree: the link each one is, what it hangs on, its joints in
the order of rotation with their limits, and its triangles. Exit status 1: not fit.

Collision geometry, transmissions and plugins are not read. Joints that are written to follow others
are named: they are searched by themselves. A file that still holds xacro macros is to be expanded
first. Packages are looked for on the way up from the file and in ROS_PACKAGE_PATH.

[bold]Examples:[/bold]

    drake-pose check urdf/woman/woman.urdf
    drake-pose check arm.urdf --package arm_description=ros/arm_description
""")

CALIBRATE = _help("""
Calibrate one camera or several from pictures of a checkerboard or a ChArUco board.

Every camera's lens is found from its own pictures, the cameras' places from instants at which two
or more of them saw the board; at last everything is adjusted at once. Shown is the error of every
camera. A picture that spoils the calibration is named, and refused unless told otherwise. The
cameras written are free of distortion: take it out of the pictures with undistort.

The board's file, for 8 by 5 squares of 12 cm:

    kind: checkerboard
    squares: [8, 5]
    square_length: 0.12

[bold]Example:[/bold]

    drake-pose calibrate CALIBRATION --board board.yaml --world board:0001 --out SCENE/cameras.yaml
""")

UNDISTORT = _help("""
Take the distortion of the lenses out of pictures, as the cameras that calibrate wrote see them.

[bold]Example:[/bold]

    drake-pose undistort RECORDING --lenses SCENE/cameras_lenses.yaml --out SCENE
""")

REPRODUCE = "Run a paper's experiment: its figures beside ours."

KAMEDA = _help("""
Kameda, Minoh and Ikeda, experiment A: random poses of a woman from one silhouette each.

Every angle is drawn at random inside its limits, her silhouette is drawn (700 x 700 pixels,
parallel projection, 2.26 pixels a centimetre), and her pose is searched for with no knowledge but
the position of her head. The paper's figures stand beside ours.

[bold]Example:[/bold]

    drake-pose reproduce kameda --images 20

With --angles continuous her angles are no multiples of 20 degrees, and poses are refined between
the samples; every angle gets an interval, or is called free. --views N has her seen by N cameras,
--mismatch adds a body of other widths. The paper's method has no such angles.

--method wide also proves each pose the best of the grid, and gathers all that look the same, in a
minute and some 400 MB for each of the two at most; the table says how often that was too little.

    drake-pose reproduce kameda --angles continuous --views 2 --images 20
""")

SHIMADA = _help("""
Shimada, Shirai, Kuno and Miura: joint angles and segment lengths of a synthetic hand, one camera.

A two-finger hand moves, turns and flexes for 55 frames; joints, fingertips and segment axes are
seen with noise. A Kalman filter begins with wrong angles and wrong lengths and corrects both,
inside the limits and couplings of the paper's table 1. Over all sequences: errors, and whether the
filter's own deviations are honest.

[bold]Example:[/bold]

    drake-pose reproduce shimada --runs 20 --observed lines --out results/shimada

[bold]Every truncation on the same sequences, side by side:[/bold]

    drake-pose reproduce shimada --runs 20 --truncation all

[bold]One view, stared at for 5,000 frames: the flaw that the authors state:[/bold]

    drake-pose reproduce shimada --runs 10 --static 5000
""")

DATE = _help("""
Date, Yoshimatsu, Arita and Taniguchi: a moving person before many calibrated cameras.

A simulated person walks, reaches, leans, crouches, turns and crosses the arms; eight cameras on a
circle and one at the face see it, 640 x 480 pixels, with noise. Beside each other: the paper's
inverse kinematics alone, the paper's search for elbows and knees, and one fit to all silhouettes
at once. A track is destroyed during each motion: frames until it is right again. Times are one
core's; rendering does not count.

[bold]Example:[/bold]

    drake-pose reproduce date --cameras 5 --frames 120 --out results/date
""")

CAPTURE = _help("""
Capture one moving person in a scene with several calibrated cameras, from masks alone.

Nothing need be known of the person: lengths and girths are fitted to the first frames. This is
[bold]estimate[/bold] with the bundled person, and writes the same: report.html, which names bad
cameras, poses.csv, joint_centres.csv, TRC, MOT and BVH files, overlays, and replay.html. A
recording is captured as a whole: after Ctrl-C, --resume begins it again.

[bold]Example:[/bold]

    drake-pose capture SCENE --out results/person

A folder with [bold]sources.yaml[/bold] beside cameras.yaml is captured frame by frame as its
pictures come: live cameras as fast as they are, videos and folders as fast as can be. A camera that
stops is left out and taken back when it returns. Ctrl-C ends it and keeps everything but the
pictures, so there are no overlays.

    front:
      kind: device             # or folder, video
      location: 0              # a device's number or address; a path
      background: empty/front  # pictures of the empty room; or masks: true
    side: {kind: video, location: side.mp4, background: empty/side}

[bold]Example:[/bold]

    drake-pose capture STUDIO --out results/person --seconds 60
""")

EMPTY_ROOM = _help("""
Take pictures of the empty room with the cameras of a sources.yaml, into their background folders.

What differs from them is the person, so leave the room first, and take them anew when the light
changes or a camera moves.

[bold]Example:[/bold]

    drake-pose empty-room STUDIO
""")

WALK = _help("""
Walk through a garden in the browser, as an avatar that moves like the captured person.

The room of the capture is small, so where one stands in it is a command: facing right or left
turns the view, standing ahead of or behind the first frame's place walks forward or backward.
Plays a result of capture, a simulated person, the person before live cameras (who commands after
standing still for a second), or none of these: then the arrow keys walk. A recording is played once
a browser shows the page, and again at the press of its button.

The page can be opened on this machine alone, by all its users, and only under its own address:
other web pages that ask for it (a foreign Origin or Host) are refused. Through ssh, forward the
same port: ssh -L 7000:localhost:7000, with --no-browser --wait.

[bold]Example:[/bold]

    drake-pose walk --simulate

    drake-pose walk results/person

    drake-pose walk --live STUDIO
""")

BATCH = _help("""
Estimate many scenes, long ones in chunks of frames, by as many workers as there are.

The result is that of [bold]estimate[/bold], scene by scene, and the same however many work: chunks
are cut by the job. In a sequence the first frame of each chunk is matched and the others are
tracked; the recording of a person who is followed is not cut. A finished chunk is on the disk at
once; a worker that dies costs the chunk it had, which another one does. A scene that fails is named
and does not stop the others. Ctrl-C keeps the finished chunks; --resume computes what is missing.

The job file, whose paths are relative to it; settings are those of estimate by their names in
Python (EstimateSettings), and in defaults for all scenes; without a model it is the bundled person:

    chunk: 100
    defaults: {replay: false}
    scenes:
      monday: {scene: recordings/monday, model: arm.urdf, interval: 15}
      tuesday: {scene: recordings/tuesday, model: arm.urdf, frames: "0:99"}
      walker: {scene: recordings/walker}

Workers on this machine talk over its loopback address alone. Those of a Dask scheduler must have
the same drake_pose, and find scenes, models and DIR under the same paths as this machine does.

[bold]Example:[/bold]

    drake-pose batch jobs.yaml --out results/all --workers 2
""")
