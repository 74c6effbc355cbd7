"""HandSensor, compared with its HandSilhouette."""

import numpy as np

from drake_pose.filtering.hand_silhouette import HandSilhouette
from drake_pose.filtering.state import Belief
from drake_pose.papers.shimada import experiment_filter
from drake_pose.papers.shimada_sequences import true_states
from drake_pose.silhouette.pictures.label_renderer import mask_to_label_image
from drake_pose.systems.truncated_ekf import HandSensor
from tests.systems.bench import Bench


def test_the_hand_sensor_measures_near_the_prediction():
    belief_filter = experiment_filter()[0]
    truth = true_states(35.0, np.zeros(6))[24]
    silhouette = HandSilhouette(belief_filter, 480, 400, (239.5, 199.5))
    belief = Belief(truth, np.diag(np.full(len(truth), 1e-8)))
    sensor = Bench(HandSensor(silhouette))
    state = {"estimated_state": belief.mean, "covariance": belief.covariance.ravel()}
    for step, image in ((0.0, None), (3.0, silhouette.draw(truth) > 0)):
        sensor.give(statistics=[step, 1.0, 0.0, 0.0, 0.0], **state)
        if image is None:
            assert np.isnan(sensor["measurement"]).all()
            assert sensor["difference"] == 1.0
            continue
        sensor.give(label_image=mask_to_label_image(image))
        found = silhouette.measure(image, belief_filter.predict_belief(belief))
        np.testing.assert_array_equal(sensor["measurement"], found.y)
        np.testing.assert_array_equal(sensor["measurement_covariance"], found.covariance.ravel())
        np.testing.assert_array_equal(sensor["rough_state"], found.rough)
        assert np.count_nonzero(np.isfinite(found.y)) > 15
