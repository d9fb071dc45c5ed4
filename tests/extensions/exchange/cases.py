"""Cases of the core's tests that exchange brings."""

DEEP = {
    "exchange": (
        "its formats share the reading of files, tables and pictures with those of the core",
        "sources.ingest.decompression sources.ingest.labels.delimited sources.ingest.labels.format "
        "sources.ingest.labels.table sources.ingest.labels.text "
        "sources.ingest.plain_yaml sources.video.image_folder",
    )
}
