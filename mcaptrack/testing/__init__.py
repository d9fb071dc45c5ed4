"""Test a part of a package, such as a transform or a format, against the laws that hold for every one of its kind.

from mcaptrack.testing import check_predictor, check_transform

check_transform(MyTracker())
check_predictor(MyPredictor(steps=12, step_s=0.4))
"""

from typing import Any

import numpy as np

from mcaptrack.predictors import AnyPredictor, PeopleSeen, are_covariances, predict_among
from mcaptrack.registry import failure
from mcaptrack.testing.crews import check_crew
from mcaptrack.testing.formats import (
    check_exporter,
    check_label_format,
    check_message_reader,
    check_recording_format,
    object_entry,
)
from mcaptrack.testing.functions import (
    check_command,
    check_doctor_lines,
    check_finisher,
    check_name,
    check_report_section,
    check_scene_maker,
)
from mcaptrack.testing.stores import check_store
from mcaptrack.testing.transforms import LAWS, LawError, check_transform, same_process, sample_frames
from mcaptrack.testing.views import check_judge, check_page, check_player, check_viewer

__all__ = [
    "LAWS",
    "LawError",
    "check_command",
    "check_crew",
    "check_doctor_lines",
    "check_exporter",
    "check_finisher",
    "check_judge",
    "check_label_format",
    "check_message_reader",
    "check_name",
    "check_page",
    "check_player",
    "check_predictor",
    "check_recording_format",
    "check_report_section",
    "check_scene_maker",
    "check_store",
    "check_transform",
    "check_viewer",
    "sample_frames",
]


# The laws that hold for every predictor.


def check_predictor(predictor: AnyPredictor, *, rotates: bool = False, seed: int = 0) -> None:
    """Check a predictor against the laws that hold for every predictor.

    The laws: forecasts are finite, of the declared number of steps, with symmetric covariances and variances above
    0; the same input gives the same output, and is not changed; positions that are not known have no influence,
    nor has the order of tracks or of people, nor have people of another time or the other tracks of a batch;
    forecasts move with the positions; the process is left as it was (working folder, random state and so on).

    Parameters
    ----------
    predictor : AnyPredictor
        The predictor; it gets other people if it has ``uses_people``.
    rotates : bool, default False
        Also check that forecasts rotate with the positions.
    seed : int, default 0
        Random seed of the positions.

    Raises
    ------
    LawError
        If it breaks a law; the message names the law.

    Examples
    --------
    >>> from mcaptrack.predictors import make
    >>> from mcaptrack.testing import check_predictor
    >>> check_predictor(make("social", steps=12, step_s=0.4), rotates=True)
    """
    rng = np.random.default_rng(seed)
    valid = rng.random((8, 12)) < 0.8
    valid[:, -1] = True
    xy_m = rng.uniform(-3, 3, (8, 1, 2)) + rng.normal(0, 0.4, (8, 1, 2)) * np.arange(-11, 1)[:, None]
    xy_m = np.where(valid[..., None], xy_m + rng.normal(0, 0.05, xy_m.shape), np.nan)
    people = PeopleSeen(xy_m, valid, np.repeat([0, 1], [5, 3]), np.array([0, 1, 2, 5, 6]))

    kept = [part.copy() for part in people]

    entry = object_entry("predictor", predictor, "predict")

    def ask(people: PeopleSeen) -> tuple[Any, Any]:
        try:
            mean, cov = predict_among(predictor, people.xy_m[people.row], people.valid[people.row], people)
            return np.asarray(mean), np.asarray(cov)
        except Exception as error:  # code of other packages may raise anything
            raise LawError(f"forecasts: {failure(entry, 'gave no mean and covariance', error)}") from error

    with same_process(type(predictor).__name__):
        mean, cov = ask(people)
    shapes = ((5, predictor.steps, 2), (5, predictor.steps, 2, 2))
    if (mean.shape, cov.shape) != shapes:
        raise LawError(f"forecasts: shapes are {mean.shape} and {cov.shape}, not {shapes[0]} and {shapes[1]}")
    if not (np.isfinite(mean).all() and are_covariances(cov)):
        raise LawError("forecasts: means that are not finite, or covariances that are none")
    order, turn = rng.permutation(8), np.array([[0.6, -0.8], [0.8, 0.6]])
    mixed = PeopleSeen(xy_m[order], valid[order], people.moment[order], np.argsort(order)[people.row])
    elsewhere = xy_m + np.where(people.moment == 1, 1.5, 0.0)[:, None, None]
    laws: dict[str, tuple[PeopleSeen, Any, Any, slice]] = {
        "pure: the same input gives the same output": (people, mean, cov, slice(None)),
        "unknown: positions that are not known have no influence": (
            people._replace(xy_m=np.where(valid[..., None], xy_m, 7.0)), mean, cov, slice(None),
        ),
        "order-blind: the order of people has no influence": (mixed, mean, cov, slice(None)),
        "batch: the other tracks of a batch have no influence": (
            people._replace(row=people.row[:1]), mean[:1], cov[:1], slice(None),
        ),
        "moment: people of another time have no influence": (
            people._replace(xy_m=elsewhere), mean[:3], cov[:3], slice(3),
        ),
        "moves: forecasts move with the positions": (people._replace(xy_m=xy_m + 5), mean + 5, cov, slice(None)),
    }  # fmt: skip
    if rotates:
        turned = people._replace(xy_m=xy_m @ turn.T)
        laws["rotates: forecasts rotate with the positions"] = turned, mean @ turn.T, turn @ cov @ turn.T, slice(None)
    for law, (changed, wanted_mean, wanted_cov, which) in laws.items():
        found_mean, found_cov = (part[which] for part in ask(changed))
        close = np.allclose(found_mean, wanted_mean, atol=1e-6) and np.allclose(found_cov, wanted_cov, atol=1e-6)
        unchanged = all(np.array_equal(a, b, equal_nan=a.dtype.kind == "f") for a, b in zip(people, kept, strict=True))
        if not (close and unchanged):
            raise LawError(law if unchanged else "pure: it changes its input")
