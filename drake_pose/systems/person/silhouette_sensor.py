"""One camera's share of following a person, as a Drake system."""

from __future__ import annotations

from pydrake.systems.framework import Context
from pydrake.systems.sensors import ImageLabel16I, ImageRgba8U

from drake_pose.camera.models import Camera
from drake_pose.person.views import EDGE_POINTS, Mask, SilhouetteView, edge_spacing, see_silhouette
from drake_pose.silhouette.pictures.label_images import label_image_to_mask
from drake_pose.silhouette.segmentation.background import Background, person_region
from drake_pose.systems.colour_images import colour_image_to_picture
from drake_pose.systems.ports import PortedSystem


class SilhouetteSensor(PortedSystem):
    """What one camera's picture says of the person.

    .. pydrake_system::

        name: SilhouetteSensor
        input_ports: [label_image]
        output_ports: [region, silhouette]

    With a background the input port is ``color_image`` instead. The outputs are abstract: the
    person's region (H, W), and a SilhouetteView of it; None where the port is not connected or the
    image has no pixels: then the camera gave no picture at that moment.

    Args:
        background: what it sees of the empty room; None: the input is a label image.
        edge_points: the picture's height over the spacing of the edge points.
    """

    def __init__(
        self,
        camera: Camera,
        background: Background | None = None,
        edge_points: float = EDGE_POINTS,
    ) -> None:
        super().__init__()
        spacing, size = edge_spacing(camera, edge_points), (camera.width, camera.height)
        if background is None:
            port = self.add_input("label_image", ImageLabel16I(*size))
        else:
            port = self.add_input("color_image", ImageRgba8U(*size))

        def see(context: Context) -> Mask | None:
            image = self.given(context, port.get_name())
            if image is None or image.size() == 0:
                return None
            if background is None:
                return label_image_to_mask(image)
            return person_region(colour_image_to_picture(image), background)

        region = self.add_output("region", None, see)

        def view(context: Context) -> SilhouetteView | None:
            seen = region.Eval(context)
            return None if seen is None else see_silhouette(seen, spacing)

        self.add_output("silhouette", None, view)
