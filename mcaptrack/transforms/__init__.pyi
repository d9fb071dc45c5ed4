from collections.abc import Mapping

from mcaptrack.transforms.detect import KnnDetector as KnnDetector
from mcaptrack.transforms.detect import MedianDetector as MedianDetector
from mcaptrack.transforms.ground import GroundTracker as GroundTracker
from mcaptrack.transforms.motion import EstimateMotion as EstimateMotion
from mcaptrack.transforms.predict import Predict as Predict
from mcaptrack.transforms.protocol import Transform as Transform
from mcaptrack.transforms.retrack import PROFILES as PROFILES
from mcaptrack.transforms.retrack import Retrack as Retrack
from mcaptrack.transforms.retrack import RetrackByConsistency as RetrackByConsistency
from mcaptrack.transforms.sample import Sample as Sample
from mcaptrack.transforms.sort import ByteTrack as ByteTrack
from mcaptrack.transforms.sort import OcSort as OcSort
from mcaptrack.transforms.sort import Sort as Sort
from mcaptrack.transforms.stages import FULL as FULL
from mcaptrack.transforms.stages import STAGES as STAGES
from mcaptrack.transforms.stages import Stage as Stage

TRANSFORMS: Mapping[str, type[Transform]]
TRACKERS: Mapping[str, type[Transform]]
