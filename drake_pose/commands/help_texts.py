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

Input: any model file that Drake reads (URDF, SDFormat, MJCF), and a scene: a folder with
[bold]cameras.yaml[/bold] and black and white [bold]masks/<camera>/<frame>.png[/bold]. Output: the
joint angles in each frame, which of them the silhouettes determine and how well, and other poses
that look the same. No training, no GPU. For a first result run [bold]drake-pose demo[/bold].

Exit status: 0 done, 1 failed (the message says what is at fault), 2 wrong usage.
""")

ESTIMATE = _help(r"""
Estimate the joint angles in every frame of a scene.

A beam search places the body link by link from the root outwards; the best poses are refined to
continuous angles by fitting the body's contour to the silhouettes' edges. Masks may have holes,
shadows and occluders. All cameras are used together. With --method paper it is the search of
Kameda, Minoh and Ikeda as published.

If scene.yaml has [bold]sequence: true[/bold], the pose is searched in the first frame, tracked by
the body's contour inside the joint limits from there on, and searched again when the track is lost.

A person before two or more calibrated cameras is followed by all silhouettes at once (--method
person), and lengths and girths are fitted where the model has joints for them. By default this is
done if the model has a person's landmarks and joints that place its root, as
urdf/person/person_shape.urdf does, and no option of the search is given.

Files in DIR: report.html, which shows all of it; poses.csv (a row a frame: every joint's position
in rad or m, E_total, seconds); joints.csv (which joints the silhouettes determine, and their 95 %
intervals); families.csv (poses that look the same); summary.json;
overlay/<camera>/<frame>.png; replay.html; joint_centres.csv if landmarks.yaml lies beside the
model; of a sequence also joint_centres.trc, positions.mot and motion.bvh. E_total is the area where
body and silhouettes differ, over the silhouettes' area; 0 is a perfect match. Ctrl-C keeps the
finished frames; --resume continues.

[bold]A robot arm whose base is at the world's origin, seen by two cameras:[/bold]

    drake-pose estimate ../shared/data/arm_two_views --out results/arm \
      --model ../shared/data/arm_two_views/med7/med7.urdf

[bold]A man who stands on a foot whose position is known, seen by one camera:[/bold]

    drake-pose estimate ../shared/data/human_four_views --out results/man \
      --model urdf/man/man.urdf --camera cam04 --frame 0:9 --root right_foot \
      --root-position ../shared/data/human_four_views/joint_centres.csv:right_ankle \
      --root-rotation y=-180:180,x=-20:20,z=-20:20
""")

DEMO = _help("""
Estimate the pose in a stored real mask: a man balancing on a beam, seen by one camera.

Only the position of his right ankle is known. The search begins at that foot and finds all other
joint angles, as in Kameda, Minoh and Ikeda's experiment with real people. The model is a man of
average measures, not fitted to this man.

[bold]Example:[/bold]

    drake-pose demo --out results/demo
""")

CHECK = _help("""
Check whether a model is fit for pose estimation, and if not, why.

A fit model has visual geometry, and limits on every prismatic joint that is searched. The table
shows the pose tree in the order of the search: each link, its parent, the joints between them in
the order of rotation with their limits, and the link's number of triangles. Exit status 1: not fit.

Collision geometry, transmissions and plugins are not read. Mimic joints and other couplings are
named in a warning and not enforced. Expand xacro macros first. Packages are searched for in the
folders above the model's file and in ROS_PACKAGE_PATH.

[bold]Examples:[/bold]

    drake-pose check urdf/woman/woman.urdf
    drake-pose check arm.urdf --package arm_description=ros/arm_description
""")

CALIBRATE = _help("""
Calibrate one camera or several from pictures of a checkerboard or a ChArUco board.

Intrinsics and distortion are found for each camera from its own pictures, extrinsics from instants
at which two or more cameras saw the board; a bundle adjustment then refines all of them. The table
shows the reprojection error of each camera. A picture that spoils the calibration is an error that
names it; --drop-spoilt leaves such pictures out. The written cameras have no distortion: remove it
from the pictures with undistort.

The board's file, for 8 by 5 squares of 12 cm:

    kind: checkerboard
    squares: [8, 5]
    square_length: 0.12

[bold]Example:[/bold]

    drake-pose calibrate CALIBRATION --board board.yaml --world board:0001 --out SCENE/cameras.yaml
""")

UNDISTORT = _help("""
Remove the lenses' distortion from pictures.

The pictures written fit the cameras that calibrate wrote together with the lens file.

[bold]Example:[/bold]

    drake-pose undistort RECORDING --lenses SCENE/cameras_lenses.yaml --out SCENE
""")

REGISTER = _help(r"""
Find where cameras stand, from masks of a robot or a person: no board, no guess.

All rotations of a camera are tried, each with the robot where the silhouettes are; the best are
fitted by the robot's contour, in the end only to what fits, so that a tool which the model lacks, a
hidden base or a wrong frame pulls no more. The answer has a standard deviation for place and
rotation, other poses that fit no worse, and the frames that contradict the others.

The focal length and principal point of each camera must be known, and the pictures be free of
distortion. The world is the model's: the robot's base, in most files. Five poses that differ much
are enough. Cameras that have an X_WC are held, and compared with the robot; --camera finds one of
them anew.

Without --joints the body's poses are estimated from the cameras that have an X_WC: one for a robot
on its base, two for a person; then the poses and the missing cameras are fitted together. --joints
may also be the poses.csv of an estimate, in which the base may move.

Files in DIR: cameras.yaml, which estimate reads (copy it into the scene); report.html, which shows
all of it; registration.yaml (6 x 6 covariance, other poses); summary.json;
overlay/<camera>/<frame>.png. Nothing is written where no pose explains the masks (exit status 1).

--on LINK finds cameras that ride on a link, from masks of the robot's base, or of a rigid object
that stands anywhere in its world (--target FILE); where the object stands is found, too.

[bold]A robot arm whose camera nobody measured:[/bold]

    drake-pose register ../shared/data/arm_one_view --out results/camera \
      --model ../shared/data/arm_two_views/med7/med7.urdf \
      --joints ../shared/data/arm_one_view/joint_angles.csv

[bold]Both cameras of a scene anew, whatever its cameras.yaml says:[/bold]

    drake-pose register ../shared/data/arm_two_views --out results/cameras \
      --model ../shared/data/arm_two_views/med7/med7.urdf --camera left --camera right \
      --joints ../shared/data/arm_two_views/joint_angles.csv

[bold]One camera of four, by a person whom the other three see:[/bold]

    drake-pose register ../shared/data/human_four_views --out results/third \
      --model urdf/person/person_shape.urdf --camera cam03
""")

AUDIT = _help(r"""
Say which frames, cameras or joints contradict the rest, where masks, cameras and joint positions
are all given.

Each frame is fitted by itself with its joints and cameras free to move a little. What all frames
are off alike is the fault of a joint's zero, of a camera or of the base; a frame is named that is
off from the others: its positions are those of another moment, a joint, the base or a camera has
moved. Named is what is significant, errors of masks and surfaces counted, and moves outlines by a
pixel or more. Time grows with the number of frames.

With one camera, a base that has moved looks like a camera that has. Of causes that explain the
masks equally well all are told.

Files in DIR: summary.json; overlay/<camera>/<frame>.png of the frames that contradict the others.

[bold]Whose positions are not those of the pictures:[/bold]

    drake-pose audit ../shared/data/franka_one_view \
      --model ../shared/data/franka_one_view/panda/panda.urdf \
      --cameras ../shared/data/franka_one_view/cameras_reference.yaml \
      --joints ../shared/data/franka_one_view/joint_angles.csv
""")

MASKS = _help(r"""
Make a scene of masks, as estimate reads them: of masks that other tools wrote, or of pictures.

Masks of other tools are COCO files (polygons and run lengths), labelme files, PNG pictures with a
palette, with an alpha channel or with probabilities (8 or 16 bits, from one half on), and black and
white videos.

In pictures and videos an object is found by the empty room (--background), a box or strokes (--box,
--strokes, or --draw, a page in the browser; GrabCut, for stills), a network of yours (--network,
ONNX), or the object's own model (--model, with rough joint positions of each frame, --start, and
cameras that have X_WC): pose and mask are found in turn, and the pictures of a camera that stands
still show its background beside the body. Where pose and colours do not
agree no mask is written, and the picture is named.

A median of the pictures stands for the empty room only where the body leaves every place; the
command says where it does not. Look at overlay/ before you go on.

Files in SCENE: masks/<camera>/<frame>.png; cameras.yaml and scene.yaml, those of SOURCE, or what a
video says; overlay/<camera>/<frame>.jpg, the pictures with the masks' outlines; summary.json, each
mask's area, refusal and warnings. A mask that is empty or full is not written, but named; one of
two patches, or along most of the picture's border, is named. Where no mask is good nothing is
written (exit status 1).

[bold]What an annotator drew in COCO format, robot and gripper together:[/bold]

    drake-pose masks annotations.json --out scene --cameras cameras.yaml \
      --class robot --class gripper

[bold]Probabilities that a network wrote, as pictures images/<camera>/<frame>.png:[/bold]

    drake-pose masks probabilities --out scene --pixels probability --largest

[bold]A recording beside which background/<camera>.png shows the empty room:[/bold]

    drake-pose masks recording --out scene

[bold]A photograph, the object in a box:[/bold]

    drake-pose masks photograph.jpg --out scene --box 120,80,300,260

[bold]A robot whose joint positions are known to about five degrees:[/bold]

    drake-pose masks ../shared/data/franka_one_view/images --out scene \
      --model ../shared/data/franka_one_view/panda/panda.urdf \
      --start ../shared/data/franka_one_view/joint_angles_fitted.csv \
      --cameras ../shared/data/franka_one_view/cameras_reference.yaml
""")

REPRODUCE = "Run a paper's experiment and show its figures beside ours."

REPRODUCE_ALL = _help("""
The experiments of the three papers, and one page about them, report.html: tables of the papers'
figures beside ours where the papers give some, and pictures.

An experiment that is finished is kept: after Ctrl-C, --resume goes on with the others.

[bold]Example:[/bold]

    drake-pose reproduce all --out results/papers
""")

KAMEDA = _help("""
Kameda, Minoh and Ikeda, experiment A: random poses of a woman, one silhouette each; B and C below.

Every angle is drawn at random inside its limits, the silhouette is rendered (700 x 700 pixels,
parallel projection, 2.26 pixels a centimetre), and the pose is searched given nothing but the
position of the head. The table shows the paper's figures beside ours.

[bold]Example:[/bold]

    drake-pose reproduce kameda --images 20

With --outside-weight 10 the paper's method runs once more, its lists ordered by e less ten times
the area outside the silhouette. The paper does not say so, but its figures come out near: a
hypothesis.
With --seeds 5 every figure is shown with its smallest and largest value over five seeds.

With --method beam, a beam search on the same grid runs beside the paper's method; branch and bound
then proves its poses optimal, and all poses that look the same are collected. Both stop at a number
of poses and at some 400 MB; the table says how often that was too little.

With --angles continuous the angles are no multiples of 20 degrees, and poses are refined between
the samples; every angle gets a 95 % interval, or is called free. --views N uses N cameras,
--mismatch adds a body whose widths and joints differ from the model's. The paper's method does not
apply there.

    drake-pose reproduce kameda --angles continuous --views 2 --images 20

[bold]Experiments B and C:[/bold] real silhouettes, one camera

B is a man, the position of whose right ankle is known; C a hand, that of whose wrist is known; the
models are of other people. Both methods search every picture for itself; --out keeps the poses and
overlays of each.

    drake-pose reproduce kameda --experiment B --out results/experiment_b
""")

SHIMADA = _help("""
Shimada, Shirai, Kuno and Miura: joint angles and segment lengths of a synthetic hand, one camera.

A two-finger hand moves, turns and flexes for 55 frames; wrist, fingertips, segment axes and palm
are measured with noise (with --observed full the knuckles, too). A Kalman filter starts from wrong
angles and lengths and corrects both, its belief truncated by the limits and couplings of the
paper's table 1. The table shows errors over all sequences, and whether they agree with the filter's
covariance (NEES).

[bold]Example:[/bold]

    drake-pose reproduce shimada --runs 20 --out results/shimada

[bold]The paper's own filter:[/bold] one linearisation a frame, one inequality after another

    drake-pose reproduce shimada --iterations 1 --truncation sequential

[bold]Several hypotheses, and which inequality rejects the wrong ones (figure 9):[/bold]

    drake-pose reproduce shimada --hypotheses --out results/figure_9

[bold]All truncations on the same sequences:[/bold]

    drake-pose reproduce shimada --runs 20 --truncation all

[bold]One unchanging view for 5,000 frames, the limitation that the authors state:[/bold]

    drake-pose reproduce shimada --runs 10 --static 5000
""")

DATE = _help("""
Date, Yoshimatsu, Arita and Taniguchi: a moving person before many calibrated cameras.

A simulated person walks, reaches, leans, crouches, turns and crosses the arms, seen by eight
cameras on a circle and one at the face (640 x 480 pixels, with noise). Compared are the paper's
inverse kinematics alone, the paper's search for elbows and knees, and one fit to all silhouettes at
once. The track is destroyed once during each motion, and the frames until it has recovered are
counted. Times are those of one core, without rendering.

[bold]Example:[/bold]

    drake-pose reproduce date --cameras 5 --frames 120 --out results/date

Elbows and knees are also compared as found, before the model with its stiff trunk is laid through
them. The waist formula has this person's constants, or with --waist paper those of the paper; with
--search rectangles they are searched as the paper has it.
""")

CAPTURE = _help("""
Capture the motion of one person before several calibrated cameras, from masks or live.

Nothing need be known of the person: lengths and girths are fitted to the first frames. This is
[bold]estimate[/bold] with the bundled person as the model, and writes the same files: report.html,
which also names faulty cameras, poses.csv, joint_centres.csv, TRC, MOT and BVH files, overlays and
replay.html. A recording is captured as a whole: after Ctrl-C, --resume starts it again.

[bold]Example:[/bold]

    drake-pose capture SCENE --out results/person

A sequence of pictures, images/<camera>/<frame>.png or videos/<camera>.mp4, needs masks of its first
frame alone, in two cameras or more, and is followed by colour. With --start FILE.csv no mask is
needed: lengths are then those of that row, girths the model's.

If the folder has [bold]sources.yaml[/bold] beside cameras.yaml, frames are captured as they come:
from live cameras in real time, from videos and folders as fast as possible. A camera that stops is
left out until it returns. Ctrl-C ends the capture and keeps the result; pictures are not stored, so
there are no overlays.

    front:
      kind: device             # or folder, video
      location: 0              # a device's number or address; a path
      background: empty/front  # pictures of the empty room; or masks: true
    side: {kind: video, location: side.mp4, background: empty/side}

[bold]Example:[/bold]

    drake-pose capture STUDIO --out results/person --seconds 60

[bold]--method paper[/bold] runs the stages of Date, Yoshimatsu, Arita and Taniguchi in a folder
with sources.yaml whose cameras give colour pictures: skin seen by two cameras or more gives head,
hands and feet, inverse kinematics the rest, a search elbows and knees. The person must show the
registered pose once, upright with both arms spread: before that there is no pose. It needs a bare
face, hands and feet, no other skin, an upright trunk, and a model of the person's measures. It has
no intervals and does not notice when it loses the person: frames whose silhouettes differ much from
the body's, and parts that were not seen, are named at the end.
""")

EMPTY_ROOM = _help("""
Take pictures of the empty room with the cameras of a sources.yaml, into their background folders.

Live capture finds the person as what differs from these pictures. Leave the room first, and take
them again when the light changes or a camera moves.

[bold]Example:[/bold]

    drake-pose empty-room STUDIO
""")

WALK = _help("""
Walk through a garden in the browser as an avatar that moves like the captured person.

The person's place and direction are commands: facing right or left turns the view, standing ahead
of or behind the place of the first frame walks forward or backward (with --method paper, as Date et
al. have it, only while also walking on the spot). The motion is that of a result
of capture, of a simulated person (--simulate) or of the person before live cameras (--live;
commands begin after standing still for a second). With none of these, the arrow keys walk. A
recording starts when a browser shows the page, and again when its button is pressed.

The page can be opened on this machine only, by all its users, and only under its own address:
requests by other web pages (a foreign Origin or Host) are refused. Through ssh, forward the same
port: ssh -L 7000:localhost:7000, with --port 7000 --no-browser --wait.

[bold]Examples:[/bold]

    drake-pose walk results/person

    drake-pose walk --simulate

    drake-pose walk --live STUDIO
""")

BATCH = _help("""
Estimate or audit many scenes on several worker processes, long scenes in chunks of frames.

The result of each scene is that of [bold]estimate[/bold] and does not depend on the number of
workers: the job file says how scenes are cut. In a sequence the first frame of each chunk is
searched and the others are tracked; the recording of a person before several cameras is not cut.
A finished chunk is on the disk at once; the chunk of a worker that dies is done by another one. A
scene that fails is named and does not stop the others. Ctrl-C keeps the finished chunks; --resume
continues.

The job file. Paths are relative to it; settings are the options of estimate by their names in
Python (EstimateSettings), and those in defaults are for all scenes. A scene without a model is of a
person, and the bundled one is used:

    chunk: 100
    defaults: {replay: false}
    scenes:
      monday: {scene: recordings/monday, model: arm.urdf, interval: 15}
      tuesday: {scene: recordings/tuesday, model: arm.urdf, frames: "0:99"}
      walker: {scene: recordings/walker}
      robot: {scene: recordings/robot, model: arm.urdf, audit: recordings/robot/joints.csv}

A scene that has 'audit', a table of joint positions, is audited (see [bold]audit[/bold]) in place
of estimated; camera_file is then its --cameras. What contradicts in all scenes is in
DIR/contradictions.csv.

Workers on this machine communicate over its loopback address only. The workers of a Dask scheduler
must have the same version of drake_pose, and find scenes, models and DIR under the same paths.

[bold]Example:[/bold]

    drake-pose batch jobs.yaml --out results/all --workers 2
""")
