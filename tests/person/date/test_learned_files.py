"""Backgrounds and faces kept in files, and faces learned from recorded pictures."""

import io
import zipfile

import cv2
import numpy as np
import pytest

from drake_pose.camera.rigs import FACE_CAMERA
from drake_pose.errors import OutputError, SceneError
from drake_pose.person.date.faces import find_face
from drake_pose.person.date.learned_files import (
    learn_recorded_faces,
    load_background,
    load_faces,
    save_background,
    save_faces,
)
from drake_pose.silhouette.segmentation.background import learn_background
from tests.person.studio import shared_studio

TURNS, NODS = (-40.0, -20.0, 0.0, 20.0, 40.0), (-10.0, 10.0)


@pytest.fixture(scope="module")
def studio():
    return shared_studio()


@pytest.fixture
def background():
    pictures = np.random.default_rng(0).integers(0, 255, (3, 6, 8, 3)).astype(np.uint8)
    return learn_background(list(pictures))


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
    def test_direction_of_another_picture(self, studio, folder, tmp_path):
        faces = learn_recorded_faces(folder)
        assert faces.directions.shape == (10, 2)
        save_faces(tmp_path / "faces.npz", faces)
        faces = load_faces(tmp_path / "faces.npz")
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
            ("", "first line must be picture,turn,nod"),
            ("picture,turn\n", "first line must be picture,turn,nod"),
            ("picture,turn,nod\n+0_+10.png,1\n", "line 2: expected a picture and two angles"),
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


class TestFiles:
    def test_background_there_and_back(self, background, tmp_path):
        path = tmp_path / "camera.npz"
        save_background(path, background)
        found = load_background(path)
        np.testing.assert_array_equal(found.mean, background.mean)
        np.testing.assert_array_equal(found.deviation, background.deviation)
        assert found.deviation.dtype == np.float32
        assert [file.name for file in tmp_path.iterdir()] == ["camera.npz"]

    def test_faces_there_and_back(self, studio, tmp_path):
        path = tmp_path / "faces.npz"
        save_faces(path, studio.templates)
        found = load_faces(path)
        for name in ("mean", "basis", "coordinates", "directions"):
            np.testing.assert_array_equal(getattr(found, name), getattr(studio.templates, name))

    def test_what_is_no_background_is_refused(self, background, studio, tmp_path):
        path = tmp_path / "wrong.npz"
        with pytest.raises(SceneError, match=r"wrong\.npz: cannot read"):
            load_background(path)
        path.write_bytes(b"nonsense")
        with pytest.raises(SceneError, match=r"wrong\.npz: is not a background"):
            load_background(path)
        save_background(path, background)
        with pytest.raises(SceneError, match="not templates of a face: it has no array"):
            load_faces(path)
        data = bytearray(path.read_bytes())
        data[60] ^= 0xFF
        path.write_bytes(data)
        with pytest.raises(SceneError, match=r"wrong\.npz"):
            load_background(path)
        for mean, deviation in (
            (background.mean[:2], background.deviation),
            (background.mean, 0.0 * background.deviation),
            (background.mean.astype(float), background.deviation),
            (background.mean, background.deviation * np.float32(np.nan)),
        ):
            with path.open("wb") as file:
                np.savez(file, mean=mean, deviation=deviation)
            with pytest.raises(SceneError, match=r"wrong\.npz"):
                load_background(path)
        save_faces(path, studio.templates)
        arrays = dict(np.load(path))
        arrays["basis"] = arrays["basis"][:5]
        with path.open("wb") as file:
            np.savez(file, **arrays)
        with pytest.raises(SceneError, match="coordinates of 54 templates in 5 dimensions"):
            load_faces(path)

    def test_pickles_are_not_opened(self, background, tmp_path):
        path = tmp_path / "pickle.npz"
        data = io.BytesIO()
        np.save(data, np.array([print], dtype=object), allow_pickle=True)
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("mean.npy", data.getvalue())
            archive.writestr("deviation.npy", data.getvalue())
        with pytest.raises(SceneError, match="is not a background"):
            load_background(path)

    def test_no_place_to_write(self, background, tmp_path):
        with pytest.raises(OutputError, match="cannot be written"):
            save_background(tmp_path / "none" / "camera.npz", background)
