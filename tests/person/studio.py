"""A simulated person before nine small simulated cameras, shared by the capture's tests."""

from functools import cached_property

import numpy as np

from drake_pose.body import bundled_model, load_model
from drake_pose.camera.models import FACE_CAMERA, circle_of_cameras
from drake_pose.person.date import features
from drake_pose.person.date.skeleton import load_skeleton, registered_positions
from drake_pose.silhouette.segmentation import learn_background
from drake_pose.systems.cameras import build_camera_rig
from tests.person.persons_in_view import posed

HEAD_HEIGHT = 1.55


class Studio:
    """The person, the cameras, and what the capture must know of them."""

    def __init__(self):
        self.model = load_model(bundled_model("person"), check=False)
        self.skeleton = load_skeleton(self.model)
        self.cameras = circle_of_cameras(8, size=(320, 240))
        self.ring = {n: c for n, c in self.cameras.items() if n != FACE_CAMERA}
        self.rig = build_camera_rig(self.model, self.cameras)
        self.context = self.rig.diagram.CreateDefaultContext()

    def posed(self, **degrees):
        return posed(self.model, z=HEAD_HEIGHT, **degrees)

    def picture(self, q, name):
        self.rig.set_positions(self.context, q)
        return self.rig.picture(self.context, name)

    def mask(self, q, name):
        self.rig.set_positions(self.context, q)
        return self.rig.mask(self.context, name)

    def view(self, q, name):
        return features.see_person(self.picture(q, name), self.mask(q, name))

    def views(self, q):
        return {name: self.view(q, name) for name in self.ring}

    def face(self, q):
        return self.picture(q, FACE_CAMERA), self.view(q, FACE_CAMERA)

    @cached_property
    def backgrounds(self):
        away = self.posed()
        away[2] = -8.0
        return {name: learn_background([self.picture(away, name)]) for name in self.cameras}

    @cached_property
    def registered(self):
        q = registered_positions(self.skeleton)
        q[2] = HEAD_HEIGHT
        cameras = list(self.ring.values())
        return features.register_pose(
            self.skeleton, q, cameras, lambda camera, q: self.mask(q, camera.name), 36
        )

    @cached_property
    def calibrated(self):
        """The skeleton whose features are where the cameras see them."""
        views = self.views(self.registered.q)
        found = features.find_features(
            list(self.ring.values()),
            list(views.values()),
            self.skeleton.features(self.registered.q),
        )
        assert (found.support > 10).all()
        return self.skeleton.with_features(self.registered.q, found.positions)

    @cached_property
    def templates(self):
        turns, nods = np.radians(np.linspace(-60, 60, 9)), np.radians(np.linspace(-25, 35, 6))
        directions = np.array([(turn, nod) for turn in turns for nod in nods])
        faces = []
        for direction in directions:
            q = self.posed()
            q[self.skeleton.head_angles] = direction
            picture, view = self.face(q)
            faces.append(features.cut_face(picture, view.blobs))
        return features.learn_faces(faces, directions)
