"""Read video files and image folders, decode pictures to gray or BGR, and encode H.264, JPEG and PNG.

FFmpeg does the work, through PyAV (its wheels include FFmpeg).
"""

from mcaptrack.sources.video.codecs import is_video_codec, read_head
from mcaptrack.sources.video.decode import EncodedPicture, decode_bgr, decode_gray, wide_samples
from mcaptrack.sources.video.encode import H264Encoder, VideoOptions, encode_image, write_clip, write_mp4
from mcaptrack.sources.video.image_folder import IMAGE_SUFFIXES, SEQINFO, SeqInfo, find_seqinfo
from mcaptrack.sources.video.pixels import (
    PIXEL_FORMATS,
    PixelFormat,
    PixelLayout,
    Samples,
    Span,
    is_mosaic,
    measured,
    measured_span,
    pixel_format,
)
from mcaptrack.sources.video.reader import PictureMessage, Video, open_video
from mcaptrack.sources.video.recognise import WORDS, Recogniser
