"""The owner of one session: its ledger, its map, and the answers that both give."""

from __future__ import annotations

import logging
import threading
from typing import BinaryIO

import numpy as np

from services.mapping.export.map_files import write_map
from services.mapping.export.pieces import Exports
from services.mapping.export.spooled import pack_folder, spooled
from services.mapping.metrics import SNAPSHOT_SECONDS
from services.mapping.pipeline import Mapper
from services.mapping.sessions.figures import MapFigures
from services.mapping.sessions.keyframe_images import KeyframeImages
from services.mapping.sessions.ledger import Ledger, Resumed
from services.mapping.sessions.opening import opening_of
from services.mapping.sessions.renders import Renders
from services.mapping.sessions.surroundings import Surroundings
from services.mapping.sessions.worker import MapWorker
from services.mapping.storage.claims import Claims
from services.mapping.storage.folders import SessionFolder
from services.mapping.storage.refinement import Refinement
from services.mapping.storage.snapshot import Snapshot, write_snapshot
from services.mapping.storage.tenure import Lease
from shared.bus import Keys
from shared.errors import ConfigError, InputError, PointSlamError
from shared.maps import (
    ExportChunk,
    ExportFormat,
    ExportRequest,
    JobStatus,
    MapInfo,
    RefineRequest,
    RenderReply,
    RenderRequest,
    SaveReply,
    Trajectory,
)
from shared.tracing import log_fields
from shared.tracks import (
    Advance,
    Advanced,
    AdvanceReply,
    ClaimReply,
    ClaimRequest,
    FrameRecord,
    OpenReply,
)

LOGGER = logging.getLogger(__name__)


class Session:
    """One session's map; its methods may be called from any thread, `advance` from one."""

    def __init__(self, folder: SessionFolder, lease: Lease, surroundings: Surroundings) -> None:
        self._folder = folder
        self._lease = lease
        self._surroundings = surroundings
        config = surroundings.config
        self.record = folder.take_up(lease.epoch)
        self._claims = Claims(folder, self.record)
        self.ledger = Ledger(folder, self.record, config.keyframes)
        self._exports = Exports(config.owner.chunk_bytes)
        self._saved = 0, 0  # log entries and iterations of the newest snapshot
        mapper = Mapper(self.record.calibration, config, self.record.seed, surroundings.device)
        self._renders = Renders(mapper, self.record.epoch, config.render)
        self._worth_saving = threading.Event()  # set by the end of a refinement, and of the session
        resumed, ended = self.ledger.resumed.refinement, self._worth_saving.set
        refinement = Refinement(folder.path, resumed, lease.check, ended)
        self._worker = MapWorker(mapper, refinement, self.record.mode, config)
        self.images = KeyframeImages(self._worker, self.ledger, self.record.calibration)
        self._take_up(mapper)
        self._calm = threading.Lock()  # held while a snapshot wants no new entries
        self._saving = threading.Lock()
        self._is_closed = threading.Event()
        self._saver = threading.Thread(target=self._save_now_and_then, daemon=True)
        self._worker.start()
        self._saver.start()

    def _take_up(self, mapper: Mapper) -> None:
        resumed = self.ledger.resumed
        if resumed.map is not None:
            self._restore(mapper, resumed)
            self._saved = self.ledger.entries - len(resumed.later), mapper.iterations
        for keyframe in resumed.later:
            self._worker.submit(keyframe)
        self.ledger.forget_resumed()

    def _restore(self, mapper: Mapper, resumed: Resumed) -> None:
        assert resumed.map is not None
        try:
            mapper.restore(resumed.map, resumed.frames, resumed.moving)
        except (KeyError, RuntimeError, ValueError) as error:
            raise ConfigError(
                f"the saved map of {self.record.session} does not fit this mapper's settings "
                f"(anchors.children, decoder.hidden and the like must be as they were): {error}"
            ) from None

    @property
    def is_working(self) -> bool:
        """Whether entries wait for the map or a refinement runs."""
        return self._worker.pending > 0 or self.refinement.is_running

    def opening(self) -> OpenReply:
        """What whoever opens the session is told."""
        return opening_of(self.record, self._surroundings.mapper, self.ledger)

    def claim(self, request: ClaimRequest) -> ClaimReply:
        """Let one gateway, and no other, advance the session from here.

        Raises:
            SteppedDownError: another mapper may own the session by now.
            StorageError: the disk refused.
        """
        with self._calm:
            self._lease.check()
            if not self._claims.take(request):
                return ClaimReply(request.held, None)
            self._tell(None)
            return ClaimReply(self._claims.newest, self.opening())

    def advance(self, entry: Advance) -> AdvanceReply:
        """Log an answered frame; its keyframe is in contexts and on disk when this returns.

        The Gaussians follow in the queue; offline the reply waits while that is too long. A
        frame that was appended before is acknowledged again.

        Raises:
            ClaimLostError: another gateway has claimed the session since.
            InputError, ConflictError, StorageError: as `Ledger.append`.
            SteppedDownError: another mapper may own the session by now; nothing is acknowledged.
        """
        with log_fields(seq=entry.record.seq), self._calm:
            self._lease.check()
            self._claims.check(entry.claim)
            if not self.ledger.holds(entry.record.seq):
                keyframe = self.ledger.append(entry)
                self._worker.submit(keyframe)
                if keyframe is not None:
                    key = Keys.revisions(self.record.session)
                    self._surroundings.publish(key, keyframe.poses)
                self._tell(entry.record)
            self._lease.check()  # this process may have been frozen before or while it wrote
        self._worker.wait_for_room()
        return AdvanceReply(entry.record.seq, self.ledger.revision)

    def _tell(self, record: FrameRecord | None) -> None:
        news = Advanced(self._claims.newest, self.ledger.revision, record)
        self._surroundings.publish(Keys.advanced(self.record.session), news)

    def render(self, request: RenderRequest) -> RenderReply:
        """A view of the map, with how well it is known; may be a kept one (`render_cache`).

        Raises:
            InputError: the view is no camera.
        """
        request.intrinsics.check("intrinsics")
        if request.T_world_camera.shape != (4, 4) or not np.isfinite(request.T_world_camera).all():
            raise InputError("T_world_camera", "must be 4x4 finite numbers")
        return self._renders.answer(request)

    def trajectory(self) -> Trajectory:
        """All answered frames; final poses go with their keyframes, as the map has them."""
        return self.ledger.trajectory(self._worker.visit(lambda mapper: mapper.views.offsets.all()))

    def export(self, request: ExportRequest) -> ExportChunk:
        """A piece of the map as a file; see `ExportRequest`.

        Raises:
            NotFoundError: the export that is named is not under way.
            StorageError: the disk refused.
        """
        if request.export:
            return self._exports.piece(request.export, request.offset)
        return self._exports.start(self._exported(request.format))

    def _exported(self, format: ExportFormat) -> BinaryIO:
        path = self._folder.path
        if format is ExportFormat.SNAPSHOT:
            if not self._is_saved():
                self.save()
            with self._saving:
                return pack_folder(path)
        visit, config = self._worker.visit, self._surroundings.config.export
        return spooled(lambda file: write_map(file, format, visit, config), path)

    @property
    def refinement(self) -> JobStatus:
        """The present or the last refinement."""
        return self._worker.refinement.status

    def refine(self, request: RefineRequest) -> JobStatus:
        """Start a refinement over all keyframes.

        Raises:
            ConflictError: one is running.
            StorageError: the disk refused.
        """
        return self._worker.refine(request.iterations)

    def interrupt(self) -> JobStatus:
        """End a refinement; a live map rests until the next entry."""
        return self._worker.interrupt()

    def save(self) -> SaveReply:
        """Write a snapshot of the session when all its entries are in the map.

        Raises:
            StorageError: the disk refused.
            SteppedDownError: another mapper may own the session by now.
        """
        with self._saving:
            with self._calm:
                self._worker.drain()
                capture = self.ledger.capture()
                revision = self.ledger.revision
                state, job = self._worker.capture()
            snapshot = Snapshot(capture.entries, state, capture.keyframes, job)
            with SNAPSHOT_SECONDS.time():
                size = write_snapshot(self._folder.path, snapshot, self._lease.check)
            self._saved = capture.entries, state.values["iterations"]
        return SaveReply(revision, size)

    def info(self) -> MapInfo:
        """The state of the map."""
        times, ledger = self._worker.times, self.ledger
        stages = self._worker.stages_ms
        figures = self._worker.visit(MapFigures.of)
        return MapInfo(
            session=self.record.session,
            mapper=self._surroundings.mapper,
            epoch=self.record.epoch,
            mode=self.record.mode,
            map_revision=ledger.revision,
            frames=ledger.entries,
            keyframes=ledger.num_keyframes,
            landmarks=ledger.num_landmarks,
            loops=ledger.num_loops,
            pending=self._worker.pending,
            refinement=self.refinement,
            stages_ms=stages,
            iteration_ms=stages.get("iteration"),
            mapping_s=times.mapping_s,
            refinement_s=times.refinement_s,
            device=str(self._surroundings.device),
            primary_anchors=figures.primary,
            secondary_anchors=figures.anchors - figures.primary,
            iterations=figures.iterations,
            psnr_db=figures.psnr_db,
            map_bytes=figures.num_bytes,
        )

    def close(self, is_saved: bool = True) -> None:
        """End the session's threads; with a snapshot unless nothing is new."""
        self._is_closed.set()
        self._worth_saving.set()
        self._saver.join()
        if is_saved:
            self._save_if_near()
        self._worker.stop()
        self._exports.close()
        self.ledger.close()

    def _save_now_and_then(self) -> None:
        interval_s = self._surroundings.config.owner.snapshot_interval_s
        while not self._is_closed.is_set():
            self._worth_saving.wait(interval_s)
            self._worth_saving.clear()
            if not self._is_closed.is_set():
                self._save_if_near()

    def _is_saved(self) -> bool:
        return self._saved == (self.ledger.entries, self._worker.iterations)

    def _save_if_near(self) -> None:
        """Save what is new, unless the map has far to go to the end of the log.

        Then the next start replays the log; waiting would keep new entries out for minutes.
        """
        owner = self._surroundings.config.owner
        if self._is_saved() or self._worker.pending > 2 * owner.max_pending:
            return
        try:
            reply = self.save()
            LOGGER.info("%s: snapshot of %d bytes", self.record.session, reply.bytes)
        except PointSlamError as error:
            LOGGER.error("%s: no snapshot: %s", self.record.session, error)
