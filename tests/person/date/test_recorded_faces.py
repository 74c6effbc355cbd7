"""Faces learned from recorded pictures."""

import cv2
import numpy as np
import pytest

from drake_pose.camera.models import FACE_CAMERA
from drake_pose.errors import SceneError
from drake_pose.person.date.features import find_face, learn_recorded_faces
from tests.person.studio import shared_studio

TURNS, NODS = (-40.0, -20.0, 0.0, 20.0, 40.0), (-10.0, 10.0)


@pytest.fixture(scope="module")
def studio():
    return shared_studio()


@pytest.fixture(scope="module")
def folder(studio, tmp_path_factory):
    """Faces recorded by the face camera, and the empty room."""
    root = tmp_path_factory.mktemp("faces")
    lines = ["picture,turn,nod"]
    for turn in TURNS:
        for nod in NODS:
            q = studio.posed()
            q[studio.skeleton.head_angles] = np.radians([turn, nod])
            name = f"{turn:+.0f}_{nod:+.0f}.png"
            cv2.imwrite(str(root / name), studio.picture(q, FACE_CAMERA)[:, :, ::-1])
            lines.append(f"{name},{turn},{nod}")
    (root / "directions.csv").write_text("\n".join(lines) + "\n\n")
    (root / "empty").mkdir()
    away = studio.posed()
    away[2] = -8.0
    cv2.imwrite(str(root / "empty" / "0.png"), studio.picture(away, FACE_CAMERA)[:, :, ::-1])
    return root


def copy_with(folder, tmp_path, directions):
    for path in folder.glob("*.png"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "directions.csv").write_text(directions)
    return tmp_path


class TestRecordedFaces:
    def test_direction_of_another_picture(self, studio, folder):
        faces = learn_recorded_faces(folder)
        assert faces.directions.shape == (10, 2)
        for direction in ([-37.0, 8.0], [16.0, -8.0]):
            q = studio.posed()
            q[studio.skeleton.head_angles] = np.radians(direction)
            picture, view = studio.face(q)
            found = np.degrees(find_face(picture, view.blobs, faces, 60.0))
            # The nearest template's: they are 20 degrees apart.
            assert found == pytest.approx(np.round(np.divide(direction, 20)) * 20, abs=10.1)
            assert np.sign(found).tolist() == np.sign(direction).tolist()

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("", "is empty"),
            ("picture,turn\n", "first line must be picture,turn,nod"),
            ("picture,turn,nod\n+0_+10.png,1\n", "line 2 has 2 columns"),
            ("picture,turn,nod\n+0_+10.png,a,1\n", "line 2: expected a picture and two angles"),
            ("picture,turn,nod\n../x.png,1,1\n", r"line 2: '\.\./x\.png' is no picture"),
            ("picture,turn,nod\n+0_+10.png,nan,1\n", "line 2: turn and nod"),
            ("picture,turn,nod\n+0_+10.png,0,1\n+0_+10.png,0,1\n", "line 3: .* has a line already"),
            ("picture,turn,nod\nno.png,0,1\n", r"no\.png: cannot read"),
        ],
    )
    def test_bad_tables_are_named(self, folder, tmp_path, text, message):
        with pytest.raises(SceneError, match=message):
            learn_recorded_faces(copy_with(folder, tmp_path, text))

    def test_bad_pictures_are_named(self, folder, tmp_path):
        with pytest.raises(SceneError, match=r"directions\.csv: cannot read"):
            learn_recorded_faces(tmp_path)
        root = copy_with(folder, tmp_path, "picture,turn,nod\ngrey.png,0,0\n")
        cv2.imwrite(str(root / "grey.png"), np.full((240, 320, 3), 128, np.uint8))
        with pytest.raises(SceneError, match=r"grey\.png: no face"):
            learn_recorded_faces(root)
        (root / "empty").mkdir()
        with pytest.raises(SceneError, match="empty: holds no picture"):
            learn_recorded_faces(root)
        cv2.imwrite(str(root / "empty" / "0.png"), np.full((24, 32, 3), 128, np.uint8))
        with pytest.raises(SceneError, match=r"grey\.png: is not as large"):
            learn_recorded_faces(root)
