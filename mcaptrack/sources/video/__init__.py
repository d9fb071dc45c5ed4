"""Packets and pixels: video files and image folders in, brightness and colours out, H.264 and JPEG between.

FFmpeg does the work, through PyAV; its wheels bring it along.
"""

from mcaptrack.sources.video.decode import Encoded, brightness, colours
from mcaptrack.sources.video.encode import H264Encoder, ImageFormat, Keep, encode_image, write_clip, write_mp4
from mcaptrack.sources.video.folder import IMAGE_SUFFIXES
from mcaptrack.sources.video.raw import RAW_ENCODINGS, Layout
from mcaptrack.sources.video.seqinfo import SEQINFO, SeqInfo, find_seqinfo
from mcaptrack.sources.video.source import EncodedPicture, Video, open_video
from mcaptrack.sources.video.streams import entry, is_video

__all__ = [
    "IMAGE_SUFFIXES",
    "RAW_ENCODINGS",
    "SEQINFO",
    "Encoded",
    "EncodedPicture",
    "H264Encoder",
    "ImageFormat",
    "Keep",
    "Layout",
    "SeqInfo",
    "Video",
    "brightness",
    "colours",
    "encode_image",
    "entry",
    "find_seqinfo",
    "is_video",
    "open_video",
    "write_clip",
    "write_mp4",
]
