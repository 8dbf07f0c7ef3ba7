"""Sessions in this process: order, durability, resume."""

from __future__ import annotations

import os
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from services.mapping.config import MappingConfig, OwnerConfig
from services.mapping.sessions.session import Session
from services.mapping.sessions.surroundings import Surroundings
from services.mapping.storage.folders import SessionFolder, SessionRecord, read_record
from services.mapping.storage.tenure import Lease
from shared import codec, se3
from shared.errors import (
    ClaimLostError,
    ConflictError,
    GoneError,
    InputError,
    UnavailableError,
)
from shared.frames import Prior
from shared.maps import ExportFormat, ExportRequest, JobState, RefineRequest, RenderRequest
from shared.tracks import Advanced, ClaimReply, ClaimRequest, ContextRequest, KeyframePoses

CONFIG = MappingConfig(owner=OwnerConfig(max_pending=2))


@pytest.fixture
def record(calibration):
    return SessionRecord("room", "offline", 7, 0, 1, calibration, np.eye(4))


@pytest.fixture
def published():
    return []


@pytest.fixture
def open_session(tmp_path, record, published):
    """Opens the session at a path, creating it the first time; closes all at the end."""
    surroundings = Surroundings(
        "m0", CONFIG, torch.device("cpu"), lambda key, news: published.append(news)
    )
    opened = []
    epochs: dict[Path, int] = {}

    def make(name: str = "room", mode: str = "offline") -> Session:
        path = tmp_path / name
        folder = SessionFolder(path)
        if not (path / "session.msgpack").exists():
            folder.write_record(replace(record, mode=mode))
        epochs[path] = epoch = read_record(path).epoch + 1
        lease = Lease(name, epoch, lambda: epoch == epochs[path])
        opened.append(Session(folder, lease, surroundings))
        return opened[-1]

    yield make
    for session in opened:
        session.close(is_saved=False)


def parameters(session: Session) -> dict[str, torch.Tensor]:
    session._worker.drain()
    return session._worker.visit(lambda mapper: mapper.state()).tensors


def test_an_advance_tells_the_revision_that_its_keyframe_made(open_session, entry):
    session = open_session()

    replies = [session.advance(entry(seq)) for seq in range(6)]

    assert [reply.map_revision for reply in replies] == [1, 1, 1, 1, 2, 2]


def test_a_repeated_entry_is_acknowledged_and_changes_nothing(open_session, entry):
    session = open_session()
    session.advance(entry(0))

    reply = session.advance(entry(0))

    assert (reply.acknowledged_seq, reply.map_revision, session.ledger.entries) == (0, 1, 1)


def test_an_entry_older_than_the_newest_is_refused(open_session, entry):
    session = open_session()
    session.advance(entry(4))

    with pytest.raises(ConflictError, match="not newer than 4"):
        session.advance(entry(2))


def test_a_keyframe_without_its_data_is_refused(open_session, entry):
    session = open_session()

    with pytest.raises(InputError, match="both its frame and its data"):
        session.advance(replace(entry(0), keyframe=None))


def test_a_keyframe_that_cannot_be_applied_never_reaches_the_log(open_session, entry, tmp_path):
    session = open_session()
    good = entry(0)
    short = replace(good.keyframe, landmark_normals_camera=np.zeros((3, 3), np.float32))

    with pytest.raises(InputError, match="landmark_normals_camera"):
        session.advance(replace(good, keyframe=short))
    assert (tmp_path / "room" / "log-000001.bin").stat().st_size == 0


def test_a_context_holds_a_keyframe_at_once(open_session, entry):
    session = open_session()
    session.advance(entry(0))

    context = session.ledger.context(ContextRequest(1, 0))

    assert (context.num_keyframes, context.revision) == (1, 1)
    assert len(context.cloud_world.points) > 0


def test_a_neighbourhood_is_built_once_until_the_next_keyframe(open_session, entry):
    session = open_session()
    session.advance(entry(0))

    first, again = (session.ledger.context(ContextRequest(1, 0)) for _ in range(2))
    session.advance(entry(4))
    later = session.ledger.context(ContextRequest(2, 0))

    assert again is first
    assert (first.revision, later.revision) == (1, 2)


def test_every_revision_is_published(open_session, entry, published):
    session = open_session()

    for seq in range(5):
        session.advance(entry(seq))

    assert [news.revision for news in published if isinstance(news, KeyframePoses)] == [1, 2]


def test_two_runs_with_one_seed_give_the_same_map_to_the_bit(open_session, entry):
    maps = []
    for name in ("a", "b"):
        session = open_session(name)
        for seq in range(9):
            session.advance(entry(seq))
        maps.append(parameters(session))

    assert maps[0].keys() == maps[1].keys()
    assert all(torch.equal(maps[0][name], maps[1][name]) for name in maps[0])


def test_a_session_killed_after_a_snapshot_goes_on_to_the_same_map(open_session, entry, tmp_path):
    whole = open_session("whole")
    for seq in range(12):
        whole.advance(entry(seq))
    killed = open_session("killed")
    for seq in range(5):
        killed.advance(entry(seq))
    killed.save()
    for seq in range(5, 9):
        killed.advance(entry(seq))
    # What a kill leaves is what is on the disk now; the process's lock dies with it.
    not_yet = shutil.ignore_patterns("*.tmp", "snapshot-000002")  # of the end that it reaches
    shutil.copytree(tmp_path / "killed", tmp_path / "resumed", ignore=not_yet)

    resumed = open_session("resumed")
    for seq in range(9, 12):
        resumed.advance(entry(seq))

    assert resumed.ledger.revision == whole.ledger.revision
    expected, found = parameters(whole), parameters(resumed)
    assert [name for name in expected if not torch.equal(expected[name], found[name])] == []


def test_a_session_taken_up_leaves_out_what_moves_as_before(open_session, entry, tmp_path):
    cells = np.zeros((9, 12), bool)
    cells[3:7, 3:9] = True

    def masked(seq):
        made = entry(seq, is_keyframe=True)
        return replace(made, keyframe=replace(made.keyframe, moving_cells=cells))

    whole = open_session("whole")
    for seq in (0, 4):
        whole.advance(masked(seq))
    whole.save()
    shutil.copytree(tmp_path / "whole", tmp_path / "resumed")
    whole.advance(masked(8))

    resumed = open_session("resumed")
    resumed.advance(masked(8))

    expected, found = parameters(whole), parameters(resumed)
    assert [name for name in expected if not torch.equal(expected[name], found[name])] == []
    views = resumed._worker.visit(lambda mapper: mapper.views.all())
    assert [np.array_equal(view.moving_cells, cells) for view in views] == [True] * 3


def test_a_session_resumes_from_the_log_alone(open_session, entry, tmp_path):
    session = open_session()
    for seq in range(6):
        session.advance(entry(seq))
    shutil.copytree(tmp_path / "room", tmp_path / "copy")

    resumed = open_session("copy")

    assert resumed.opening().last is not None
    assert resumed.opening().last.seq == 5
    assert resumed.opening().keyframe_poses.seqs.tolist() == [0, 4]
    assert resumed.record.epoch == session.record.epoch + 1


def test_final_poses_follow_their_keyframe(open_session, entry, true_pose):
    session = open_session()
    session.advance(entry(0))
    session.advance(entry(1))
    moved = se3.exp([0.1, 0, 0, 0, 0, 0]) @ true_pose(0)
    correction = entry(4)
    old = correction.keyframe.correction
    poses = np.stack([moved, true_pose(4)])
    new = replace(old, keyframe_seqs=np.array([0, 4]), T_world_keyframes=poses)
    session.advance(replace(correction, keyframe=replace(correction.keyframe, correction=new)))

    final = session.trajectory().T_world_cameras_final

    np.testing.assert_allclose(final[1][:3, 3] - true_pose(1)[:3, 3], [0.1, 0, 0], atol=1e-9)


def test_final_poses_are_where_a_refinement_put_their_keyframe(open_session, entry):
    session = open_session()
    for seq in (0, 4, 5):  # 5 is no keyframe
        session.advance(entry(seq))
    before = session.trajectory().T_world_cameras_final
    refined(session, 20)

    after = session.trajectory().T_world_cameras_final

    T_new_old = after[1] @ se3.inverse(before[1])
    assert np.abs(T_new_old - np.eye(4)).max() > 0
    np.testing.assert_allclose(after[2], T_new_old @ before[2], atol=1e-12)


def test_a_refinement_runs_to_its_end_and_says_so(open_session, entry):
    session = open_session()
    session.advance(entry(0))

    session.refine(RefineRequest(3))
    while session.refinement.is_running:
        os.sched_yield()

    assert session.refinement.state is JobState.DONE
    assert (session.refinement.iterations_done, session.refinement.job) == (3, 1)
    assert session.refinement.psnr_db == session.info().psnr_db


def test_what_a_refinement_did_is_in_a_snapshot_soon_after_its_end(open_session, entry, tmp_path):
    session = open_session()
    session.advance(entry(0))
    refined(session, 5)
    while not (tmp_path / "room" / "snapshot-000001").exists():
        time.sleep(0.005)

    resumed = open_session()

    assert resumed.info().iterations == session.info().iterations


def test_a_refinement_goes_on_from_the_snapshot_when_its_owner_is_gone(
    open_session, entry, tmp_path
):
    whole = open_session("whole")
    whole.advance(entry(0))
    refined(whole, 12)
    killed = open_session("killed")
    killed.advance(entry(0))
    killed.refine(RefineRequest(12))
    while killed.refinement.iterations_done < 3:
        os.sched_yield()
    killed.save()
    not_yet = shutil.ignore_patterns("*.tmp", "snapshot-000002")  # of the end that it reaches
    shutil.copytree(tmp_path / "killed", tmp_path / "resumed", ignore=not_yet)

    resumed = open_session("resumed")
    while resumed.refinement.is_running:
        os.sched_yield()

    assert resumed.refinement.iterations_done == 12
    expected, found = parameters(whole), parameters(resumed)
    assert [name for name in expected if not torch.equal(expected[name], found[name])] == []


def test_a_refinement_without_a_snapshot_starts_again(open_session, entry, tmp_path):
    session = open_session()
    session.advance(entry(0))
    session.refine(RefineRequest(10_000))
    shutil.copytree(tmp_path / "room", tmp_path / "copy")

    resumed = open_session("copy")

    assert (resumed.refinement.state, resumed.refinement.job) == (JobState.RUNNING, 1)
    assert resumed.refinement.iterations_total == 10_000


def test_an_interrupted_refinement_stays_so_and_tells_what_was_done(open_session, entry, tmp_path):
    session = open_session()
    session.advance(entry(0))
    session.refine(RefineRequest(10_000))
    while session.refinement.iterations_done < 2:
        os.sched_yield()
    interrupted = session.interrupt()
    shutil.copytree(tmp_path / "room", tmp_path / "copy")

    resumed = open_session("copy")

    assert interrupted.state is resumed.refinement.state is JobState.INTERRUPTED
    assert 2 <= interrupted.iterations_done == resumed.refinement.iterations_done
    refined(resumed, 1)
    assert resumed.refinement.job == 2


def refined(session: Session, iterations: int) -> None:
    session.refine(RefineRequest(iterations))
    while session.refinement.is_running:
        os.sched_yield()


def test_a_second_refinement_is_refused_while_one_runs(open_session, entry):
    session = open_session()
    session.advance(entry(0))
    session.refine(RefineRequest(10_000))

    with pytest.raises(ConflictError, match="interrupt"):
        session.refine(RefineRequest(1))

    assert not session.interrupt().is_running


def test_a_session_can_be_rendered_before_its_first_keyframe(open_session):
    session = open_session()

    reply = session.render(RenderRequest(np.eye(4), session.record.calibration.colour.intrinsics))

    assert reply.rgb.max() == reply.alpha.max() == reply.depth_m.max() == 0


def test_a_live_map_is_optimised_while_nothing_comes(open_session, entry):
    session = open_session(mode="live")
    session.advance(entry(0))

    while session.info().iterations < 5:
        os.sched_yield()

    assert session.info().pending == 0


def test_a_live_map_that_was_taken_up_rests_until_an_entry_comes(open_session, entry):
    first = open_session(mode="live")
    first.advance(entry(0))
    first.close()

    again = open_session()
    before = again.info().iterations
    time.sleep(0.3)

    assert again.info().iterations == before


def test_no_snapshot_tells_of_entries_that_a_closing_map_has_not_seen(
    open_session, entry, tmp_path
):
    session = open_session()
    session._worker.stop()
    session.advance(entry(0))

    with pytest.raises(UnavailableError, match="closed"):
        session.save()
    assert not list(tmp_path.glob("room/snapshot-*"))


def test_a_render_with_a_pose_that_is_no_number_is_refused(open_session):
    session = open_session()
    intrinsics = session.record.calibration.colour.intrinsics

    with pytest.raises(InputError, match="T_world_camera"):
        session.render(RenderRequest(np.full((4, 4), np.nan), intrinsics))


def test_an_owner_whose_epoch_is_over_acknowledges_nothing(open_session, entry):
    old = open_session()
    old.advance(entry(0))
    new = open_session()

    with pytest.raises(GoneError, match="epoch 1 is over"):
        old.advance(entry(1))
    with pytest.raises(GoneError):
        old.save()

    assert new.ledger.entries == 1


def test_what_a_former_owner_still_writes_is_no_part_of_the_session(open_session, entry):
    old = open_session()
    old.advance(entry(0))
    open_session().close(is_saved=False)

    old.ledger.append(entry(1))  # frozen between the check of its lease and the write

    assert open_session().ledger.entries == 1


def test_the_exported_folder_is_a_session_again(open_session, entry, tmp_path):
    session = open_session()
    session.advance(entry(0))
    request = ExportRequest(ExportFormat.SNAPSHOT)
    pieces = [session.export(request)]
    while (end := pieces[-1].offset + len(pieces[-1].bytes)) < pieces[-1].total:
        pieces.append(session.export(replace(request, export=pieces[0].export, offset=end)))
    (tmp_path / "room.tar").write_bytes(b"".join(piece.bytes for piece in pieces))
    shutil.unpack_archive(tmp_path / "room.tar", tmp_path / "elsewhere")

    resumed = open_session("elsewhere/room")

    assert resumed.ledger.num_keyframes == 1


def test_frames_of_an_older_claim_are_refused_and_leave_no_trace(open_session, entry):
    session = open_session()
    old = session.claim(ClaimRequest("a")).number
    new = session.claim(ClaimRequest("b")).number
    session.advance(replace(entry(0), claim=new))

    with pytest.raises(ClaimLostError):
        session.advance(replace(entry(1), claim=old))

    assert session.ledger.entries == 1


def test_who_has_the_newest_claim_keeps_it_by_asking_again(open_session):
    session = open_session()
    held = session.claim(ClaimRequest("a")).number

    assert session.claim(ClaimRequest("a", held)) == ClaimReply(held, None)


def test_a_claim_and_what_the_next_frame_starts_from_outlive_the_process(open_session, entry):
    session = open_session()
    claim = session.claim(ClaimRequest("a")).number
    T = np.eye(4)
    prior = Prior(0, 1, T, T, 7, 0, 0, 0, 3, frame_digest=5)
    session.advance(replace(entry(0), claim=claim, prior=prior))

    again = open_session()

    assert codec.pack(again.opening().prior) == codec.pack(prior)
    with pytest.raises(ClaimLostError):
        again.advance(entry(1))


def test_a_new_claim_is_published_and_so_is_each_frame(open_session, entry, published):
    session = open_session()
    claim = session.claim(ClaimRequest("a")).number
    session.advance(replace(entry(0), claim=claim))

    news = [each for each in published if isinstance(each, Advanced)]
    assert [(each.claim, each.record is not None) for each in news] == [(1, False), (1, True)]
