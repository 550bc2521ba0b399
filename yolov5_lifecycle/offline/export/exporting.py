"""Detection in the images of one source, written in one of the formats."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from yolov5_lifecycle.atomic_file import whole_output
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.offline.detecting import LoadDetector, OfflineDetector, RunStatistics
from yolov5_lifecycle.offline.export.crops import Crops
from yolov5_lifecycle.offline.export.detected_image import DetectedImage, NamedImage, Sink
from yolov5_lifecycle.offline.export.formats import FORMATS, JSON_LINES
from yolov5_lifecycle.offline.export.json_lines import JsonLines


@dataclass(frozen=True)
class Export:
    """Where detections go: to the new `path`, None for stdout, in the format `suffix` of FORMATS.

    The suffix "" stands for a recording.
    """

    path: Path | None
    suffix: str = JSON_LINES
    masks: bool = True
    """Whether to write the masks of a segmentation model, if the format has some."""
    crops: Path | None = None
    """New folder for an image of each detection."""

    def sinks(self, detector: OfflineDetector) -> list[Sink]:
        """Open the outputs for detections of `detector`; raises OSError."""
        names = detector.class_names
        if self.path is None:
            sinks: list[Sink] = [JsonLines(None, names, masks=self.masks)]
        else:
            sinks = [FORMATS[self.suffix].new_sink(self.path, names, masks=self.masks)]
        return sinks if self.crops is None else [*sinks, Crops(self.crops, names)]


@contextmanager
def whole_export(export: Export) -> Iterator[Export]:
    """`export` to temporary paths, which are renamed when the block succeeds, see `whole_output`."""
    with ExitStack() as stack:
        path, crops = (
            stack.enter_context(whole_output(output)) if output else None
            for output in (export.path, export.crops)
        )
        yield replace(export, path=path, crops=crops)


def export_images(
    images: Iterable[NamedImage],
    expected: int,
    export: Export,
    *,
    load: LoadDetector,
    drawings: Callable[[OfflineDetector], Sink] | None = None,
) -> RunStatistics:
    """Write the detections in `images`, of which there are `expected`; `drawings` is a further output.

    Raises OutputError, OSError, DetectingError and what `load` raises; then the outputs are damaged.
    """
    detector = load()
    with ExitStack() as stack:
        sinks = export.sinks(detector)
        if drawings is not None:
            sinks.append(drawings(detector))
        for sink in sinks:
            stack.callback(sink.close)

        def write(named: NamedImage, image: ColourImage, detections: Detections) -> None:
            found = DetectedImage(named, image, detections)
            for sink in sinks:
                sink.add(found)

        statistics = detector.run(images, expected=expected, write=write)
        for sink in sinks:
            sink.finish()
    return statistics
