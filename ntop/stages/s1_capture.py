"""Stage 1, capture: a source's raw files -> frames and cameras in our conventions."""

import shutil
from pathlib import Path

from ntop.captures.checks import check_capture
from ntop.captures.qualisys import capture_qualisys
from ntop.captures.studio import capture_studio
from ntop.config.sections import CaptureConfig
from ntop.config.sources import QualisysSource, StudioSource
from ntop.conventions import DataError
from ntop.stages import VERSIONS
from ntop.storage.atomic import publish_folder
from ntop.storage.files import check_files, record_files
from ntop.storage.provenance import file_sha256, provenance, write_provenance

STAGE = "capture"


def main(config: CaptureConfig, source: str, actor: str, packages: Path, out: Path) -> None:
    """Write frames.parquet, cameras.parquet, the footage and whatever else the source provides.

    `packages` holds the fetched packages, one folder each; `out` appears by one rename, whole and
    checked.

    Raises:
        DataError: the raw files are missing, damaged or contradict each other, or `out` cannot be
            written.
    """
    work = out.with_name(f".{out.name}.work")
    try:
        shutil.rmtree(work, ignore_errors=True)  # left by a run that was killed
        work.mkdir(parents=True)
    except OSError as error:
        raise DataError(
            f"cannot write {out}: {error.strerror}; check the permissions of its parent folders"
        ) from error
    try:
        match config.source_section:
            case QualisysSource() as settings:
                check_files(packages / settings.package)
                capture_qualisys(
                    settings,
                    source=source,
                    actor=actor,
                    sequences=config.sequences,
                    packages=packages,
                    out=work,
                )
            case StudioSource():
                capture_studio(config, source=source, actor=actor, packages=packages, out=work)
        check_capture(work)
        record = provenance(
            stage=STAGE,
            version=VERSIONS[STAGE],
            config=config.model_dump(mode="json"),
            inputs=_inputs(config, packages=packages, work=work),
        )
        write_provenance(record, folder=work)
        record_files(work)
        publish_folder(work, out)
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _inputs(config: CaptureConfig, *, packages: Path, work: Path) -> dict[str, str]:
    """Checksums of the raw files: the footage, and the calibration of a real recording."""
    footage = sorted((work / "footage").rglob("*.mp4"))
    checksums = {path.relative_to(work).as_posix(): file_sha256(path) for path in footage}
    match config.source_section:
        case QualisysSource() as settings:
            path = packages / settings.package / settings.calibration
            return checksums | {settings.calibration: file_sha256(path)}
        case StudioSource():
            return checksums
