import collections.abc
import typing

import mcaptrack.extensions.zones.api
import mcaptrack.extensions.zones.visits
import mcaptrack.transforms
from mcaptrack.api.contents import ChannelInfo as ChannelInfo
from mcaptrack.api.contents import FrameInfo as FrameInfo
from mcaptrack.api.contents import LogInfo as LogInfo
from mcaptrack.api.contents import info as info
from mcaptrack.api.demonstration import DemoResult as DemoResult
from mcaptrack.api.demonstration import demo as demo
from mcaptrack.api.exporting import ExportResult as ExportResult
from mcaptrack.api.exporting import export as export
from mcaptrack.api.health import DoctorResult as DoctorResult
from mcaptrack.api.health import doctor as doctor
from mcaptrack.api.ingesting import IngestResult as IngestResult
from mcaptrack.api.ingesting import ingest as ingest
from mcaptrack.api.messages import DecodedMessage as DecodedMessage
from mcaptrack.api.reading import FetchedMessage as FetchedMessage
from mcaptrack.api.reading import Recording as Recording
from mcaptrack.api.reading import open as open  # noqa: A004
from mcaptrack.api.rows import detections as detections
from mcaptrack.api.rows import schema_of as schema_of
from mcaptrack.api.run import run as run
from mcaptrack.api.running import RunResult as RunResult
from mcaptrack.api.scoring import Scores as Scores
from mcaptrack.api.scoring import evaluate as evaluate
from mcaptrack.api.stages import detect as detect
from mcaptrack.api.stages import events as events
from mcaptrack.api.stages import motion as motion
from mcaptrack.api.stages import predict as predict
from mcaptrack.api.stages import retrack as retrack
from mcaptrack.api.stages import sample as sample
from mcaptrack.api.stages import stage as stage
from mcaptrack.api.stages import track as track
from mcaptrack.api.upkeep import CutResult as CutResult
from mcaptrack.api.upkeep import DropResult as DropResult
from mcaptrack.api.upkeep import LogCheck as LogCheck
from mcaptrack.api.upkeep import LogRecovery as LogRecovery
from mcaptrack.api.upkeep import check as check
from mcaptrack.api.upkeep import cut as cut
from mcaptrack.api.upkeep import drop as drop
from mcaptrack.api.upkeep import recover as recover
from mcaptrack.api.viewing import LogServer as LogServer
from mcaptrack.api.viewing import view as view
from mcaptrack.errors import McaptrackError as McaptrackError
from mcaptrack.extensions.cameras.api import CalibrateResult as CalibrateResult
from mcaptrack.extensions.cameras.api import CameraCorrection as CameraCorrection
from mcaptrack.extensions.cameras.api import calibrate as calibrate
from mcaptrack.extensions.cameras.api import fuse as fuse
from mcaptrack.extensions.networks.api import get_model as get_model
from mcaptrack.extensions.networks.api import models as models
from mcaptrack.extensions.networks.catalogue import Model as Model
from mcaptrack.extensions.notebook.api import Player as Player
from mcaptrack.extensions.render.api import RenderResult as RenderResult
from mcaptrack.extensions.render.api import render as render
from mcaptrack.extensions.report.api import ReportResult as ReportResult
from mcaptrack.extensions.report.api import report as report
from mcaptrack.extensions.review.api import Review as Review
from mcaptrack.extensions.review.api import ReviewResult as ReviewResult
from mcaptrack.extensions.review.api import review as review
from mcaptrack.extensions.sql.api import ColumnInfo as ColumnInfo
from mcaptrack.extensions.sql.api import TableInfo as TableInfo
from mcaptrack.extensions.sql.api import TableList as TableList
from mcaptrack.extensions.sql.api import list_tables as list_tables
from mcaptrack.extensions.sql.api import query as query
from mcaptrack.extensions.training.api import TrainResult as TrainResult
from mcaptrack.extensions.training.api import train as train
from mcaptrack.extensions.tuning.api import TuneResult as TuneResult
from mcaptrack.extensions.tuning.api import tune as tune
from mcaptrack.extensions.zones.api import draw_zones as draw_zones
from mcaptrack.extensions.zones.api import zones as zones
from mcaptrack.notices import McaptrackWarning as McaptrackWarning
from mcaptrack.notices import Notice as Notice

_MODULES: dict[str, str]

class _RunOptions(typing.TypedDict, total=False):
    """Options of ``run`` that are of extensions."""

    fuse: bool
    fuser: str | mcaptrack.transforms.Transform | None
    zones: mcaptrack.extensions.zones.api.ZonesLike | None

class _OfFinishers:
    """Attributes of ``RunResult`` that are of finishers of extensions."""

    zones: collections.abc.Mapping[str, list[mcaptrack.extensions.zones.visits.ZoneTotals]]

__version__: str
SCHEMA_VERSION: int

# What extensions have beside these, for the message that names what is missing:
# crew dask: mcaptrack.extensions.dask
# detector onnx: mcaptrack.extensions.networks
# detector yolox-nano: mcaptrack.extensions.networks
# detector yolox-s: mcaptrack.extensions.networks
# detector yolox-tiny: mcaptrack.extensions.networks
# doctor_line networks: mcaptrack.extensions.networks
# exporter boxes-csv: mcaptrack.extensions.exchange
# exporter coco: mcaptrack.extensions.exchange
# exporter cvat: mcaptrack.extensions.exchange
# exporter kitti: mcaptrack.extensions.exchange
# exporter rerun: mcaptrack.extensions.rerun
# finisher zones: mcaptrack.extensions.zones
# fuser feet: mcaptrack.extensions.cameras
# report_section zones: mcaptrack.extensions.zones
# scene fused: mcaptrack.extensions.cameras
# store az: mcaptrack.extensions.stores
# store gs: mcaptrack.extensions.stores
# store s3: mcaptrack.extensions.stores
# exporter rosbag2: mcaptrack.extensions.bags
# exporter rosbag2-sqlite3: mcaptrack.extensions.bags
# predictor onnx: mcaptrack.extensions.networks
# recording rosbag: mcaptrack.extensions.bags
# ending .bag: mcaptrack.extensions.bags
# ending .bag.active: mcaptrack.extensions.bags
# ending .db3: mcaptrack.extensions.bags
# ending metadata.yaml: mcaptrack.extensions.bags
# label_format argoverse: mcaptrack.extensions.exchange
# label_format bdd: mcaptrack.extensions.exchange
# label_format coco: mcaptrack.extensions.exchange
# label_format cvat: mcaptrack.extensions.exchange
# label_format darknet: mcaptrack.extensions.exchange
# label_format datumaro: mcaptrack.extensions.exchange
# label_format jrdb: mcaptrack.extensions.exchange
# label_format kitti: mcaptrack.extensions.exchange
# label_format kitti-3d: mcaptrack.extensions.exchange
# label_format kitti-frames: mcaptrack.extensions.exchange
# label_format label-studio: mcaptrack.extensions.exchange
# label_format labelme: mcaptrack.extensions.exchange
# label_format levelx: mcaptrack.extensions.exchange
# label_format mots: mcaptrack.extensions.exchange
# label_format nuscenes: mcaptrack.extensions.exchange
# label_format supervision: mcaptrack.extensions.exchange
# label_format trajnet++: mcaptrack.extensions.exchange
# label_format via: mcaptrack.extensions.exchange
# label_format voc: mcaptrack.extensions.exchange
# label_format yolo: mcaptrack.extensions.exchange
# label_format youtube-vis: mcaptrack.extensions.exchange
