"""The command line: `pointslam run | evaluate | up | keys | synth | refine | export | ...`."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from pointslam.cli_client import add_client
from pointslam.cli_render import add_render_path
from pointslam.settings import read_settings
from shared.errors import PointSlamError

# Commands import what they need themselves: `up` wants no plotting, `synth` no network.


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; an error of ours is one line and exit code 2."""
    arguments = _parser().parse_args(argv)
    # SIGTERM unwinds like Ctrl-C, so that services end and scratch folders go.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    command: Callable[[argparse.Namespace], None] = arguments.command
    try:
        command(arguments)
    except (PointSlamError, OSError) as error:  # OSError: the disk, not our logic
        sys.stderr.write(f"error: {error}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="pointslam", description="RGB-D SLAM as services")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_run(commands.add_parser("run", help="stream a sequence and score the result"))
    _add_evaluate(commands.add_parser("evaluate", help="score a finished run again"))
    _add_up(commands.add_parser("up", help="start the services and keep them running"))
    _add_keys(commands.add_parser("keys", help="who may use a gateway"))
    _add_synth(commands.add_parser("synth", help="render a procedural room with exact truth"))
    _add_refine(commands.add_parser("refine", help="optimise a session's map further"))
    _add_export(commands.add_parser("export", help="a run's or a session's map as a file"))
    add_render_path(commands.add_parser("render-path", help="a video along a path in a map"))
    add_client(commands.add_parser("client", help="a camera or a recording to a gateway"))
    _add_convert(commands.add_parser("convert", help="a sequence as an MCAP file"))
    _add_bench(commands.add_parser("bench", help="measure one part"))
    return parser


def _add_settings(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--device", choices=["auto", "cpu", "cuda"], default="auto")
    parser.add_argument("--config", type=Path, metavar="FILE", help="YAML file with settings")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="one setting; its key starts with tracking, mapping, gateway, router or sequence",
    )
    parser.add_argument("--trackers", type=int, default=2, metavar="N")


def _add_run(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("sequence", type=Path, metavar="SEQUENCE")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--mode", choices=["offline", "live"], default="offline")
    parser.add_argument(
        "--speed", type=float, default=1.0, metavar="X", help="live: times that of the recording"
    )
    parser.add_argument("--max-frames", type=int, metavar="N")
    parser.add_argument("--refine", type=int, default=0, metavar="ITERATIONS")
    parser.add_argument("--holdout", type=int, default=8, metavar="K", help="0 holds none out")
    parser.add_argument("--gateway", metavar="URL", help="a running gateway instead of our own")
    parser.add_argument("--seed", type=int, default=0)
    _add_lpips(parser)
    _add_settings(parser)
    parser.set_defaults(command=_run)


def _run(arguments: argparse.Namespace) -> None:
    from pointslam.evaluation.report import text_table
    from pointslam.run import RunOptions, run_sequence

    options = RunOptions(
        sequence=arguments.sequence,
        out=arguments.out,
        mode=arguments.mode,
        speed=arguments.speed,
        max_frames=arguments.max_frames,
        refine=arguments.refine,
        holdout=arguments.holdout,
        device=arguments.device,
        gateway=arguments.gateway,
        seed=arguments.seed,
        num_trackers=arguments.trackers,
        lpips_weights=arguments.lpips_weights,
        settings=read_settings(arguments.config, arguments.set),
    )
    _say(text_table(run_sequence(options)))


def _add_evaluate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", type=Path, metavar="DIR")
    _add_lpips(parser)
    parser.set_defaults(command=_evaluate)


def _evaluate(arguments: argparse.Namespace) -> None:
    from pointslam.evaluation.report import text_table
    from pointslam.run import evaluate_run

    _say(text_table(evaluate_run(arguments.run, arguments.lpips_weights)))


def _add_lpips(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--lpips-weights",
        type=Path,
        metavar="PATH",
        help="AlexNet's or VGG16's, safetensors; LPIPS is null without",
    )


def _add_up(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", type=Path, default=Path("pointslam-data"), metavar="DIR")
    parser.add_argument("--http-port", type=int, default=8080, metavar="P")
    parser.add_argument("--grpc-port", type=int, default=50051, metavar="P")
    parser.add_argument("--mappers", type=int, default=1, metavar="N", help="share the sessions")
    parser.add_argument("--gateways", type=int, default=1, metavar="N", help="at ports P, P+1, ...")
    parser.add_argument("--traces", default="", metavar="TARGET", help="http://otlp or file:FOLDER")
    parser.add_argument(
        "--host", default="127.0.0.1", help="other than loopback needs --keys or JWT"
    )
    parser.add_argument("--keys", type=Path, metavar="FILE", help="only with a key of this store")
    parser.add_argument("--tls-certificate", type=Path, metavar="FILE", help="PEM, with its chain")
    parser.add_argument("--tls-key", type=Path, metavar="FILE", help="PEM")
    _add_settings(parser)
    parser.set_defaults(command=_up)


def _up(arguments: argparse.Namespace) -> None:
    from pointslam.launcher import Access, LaunchOptions
    from pointslam.up import keep_up

    access = Access(arguments.host, arguments.keys, arguments.tls_certificate, arguments.tls_key)
    options = LaunchOptions(
        data=arguments.data,
        logs=arguments.data / "logs",
        num_trackers=arguments.trackers,
        num_mappers=arguments.mappers,
        num_gateways=arguments.gateways,
        traces=arguments.traces,
        device=arguments.device,
        http_port=arguments.http_port,
        grpc_port=arguments.grpc_port,
        access=access,
        settings=read_settings(arguments.config, arguments.set).services,
    )
    keep_up(options, _say)


def _add_keys(parser: argparse.ArgumentParser) -> None:
    from pointslam.keys import add_key_commands

    add_key_commands(parser)
    parser.set_defaults(command=_keys)


def _keys(arguments: argparse.Namespace) -> None:
    _say(arguments.keys_command(arguments))


def _add_synth(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, metavar="DIR")
    parser.add_argument("--frames", type=int, default=120, metavar="N")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--noise", choices=["kinect", "none"], default="kinect")
    parser.set_defaults(command=_synth)


def _synth(arguments: argparse.Namespace) -> None:
    from pointslam.progress import progress_bar
    from pointslam.synth import Noise, SynthOptions, write_sequence

    noise = Noise(arguments.noise)
    options = SynthOptions(num_frames=arguments.frames, seed=arguments.seed, noise=noise)
    total = options.num_frames + options.num_views
    with progress_bar("rendering", "image") as progress:
        write_sequence(arguments.folder, options, lambda done: progress(done, total))


def _add_refine(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("session", metavar="SESSION")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--iterations", type=int, default=0, help="without: watch what is under way")
    what.add_argument("--interrupt", action="store_true", help="end what is under way")
    parser.add_argument("--gateway", metavar="URL", default="http://127.0.0.1:8080")
    parser.set_defaults(command=_refine)


def _refine(arguments: argparse.Namespace) -> None:
    from pointslam.refine import interrupt_session, refine_session

    if arguments.interrupt:
        job = interrupt_session(arguments.gateway, arguments.session)
    else:
        job = refine_session(arguments.gateway, arguments.session, arguments.iterations)
    _say(f"{job.state} after {job.iterations_done} of {job.iterations_total} iterations")


def _add_export(parser: argparse.ArgumentParser) -> None:
    from shared.maps import ExportFormat
    from shared.trajectories import TrajectoryFormat

    formats = [*ExportFormat, *TrajectoryFormat]
    parser.add_argument("source", metavar="DIR|SESSION", help="a run's folder, or a session")
    parser.add_argument("--format", choices=formats, default=ExportFormat.PLY)
    parser.add_argument("--gateway", metavar="URL", default="http://127.0.0.1:8080")
    parser.add_argument("--out", type=Path, metavar="FILE")
    parser.set_defaults(command=_export)


def _export(arguments: argparse.Namespace) -> None:
    from pointslam.export import export_source
    from shared.maps import ExportFormat
    from shared.trajectories import TrajectoryFormat

    name = arguments.format
    format = TrajectoryFormat(name) if name in set(TrajectoryFormat) else ExportFormat(name)
    target = export_source(arguments.source, format, arguments.gateway, arguments.out)
    _say(str(target))


def _add_convert(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("sequence", type=Path, metavar="SEQUENCE")
    parser.add_argument("file", type=Path, metavar="FILE.mcap")
    parser.add_argument("--trajectory", type=Path, metavar="TUM", help="poses to show, of a run")
    parser.set_defaults(command=_convert)


def _convert(arguments: argparse.Namespace) -> None:
    from pointslam.recording import convert_sequence

    convert_sequence(arguments.sequence, arguments.file, arguments.trajectory)
    _say(str(arguments.file))


def _add_bench(parser: argparse.ArgumentParser) -> None:
    from pointslam.bench import NAMES

    parser.add_argument("name", choices=NAMES)
    parser.add_argument("--json", action="store_true", help="one JSON object instead of a table")
    parser.add_argument("options", nargs=argparse.REMAINDER, help="of that benchmark; try --help")
    parser.set_defaults(command=_bench)


def _bench(arguments: argparse.Namespace) -> None:
    from pointslam.bench import run_benchmark

    as_json = ["--json"] if arguments.json else []
    run_benchmark(arguments.name, [*as_json, *arguments.options])


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
