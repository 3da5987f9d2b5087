"""The command line: ``obsnet demo``, ``track``, ``detect``, ``evaluate`` and their siblings.

Each command imports what it needs when it runs. Bad input ends in one line on standard error and exit status 2.
"""

from __future__ import annotations

import json
import os
import sys
import warnings
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from obsnet import commands, console
from obsnet.beside import usable_cores
from obsnet.errors import ConfigError

app = typer.Typer(
    name="obsnet",
    help="Detect, localise and track ships from a single ocean-bottom station.",
    context_settings={"help_option_names": ["-h", "--help"]},
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _folder(text: str | Path) -> Path:
    if not str(text).strip():
        raise typer.BadParameter("it is empty text; name a folder")
    return Path(text)


Waveforms = Annotated[
    list[str], typer.Argument(help="Waveform files, folders or an SDS archive, any format obspy reads.")
]
StationFile = Annotated[Path, typer.Option("--station", help="StationXML of the station.")]
Code = Annotated[
    str | None, typer.Option("--code", help="NET.STA, where the StationXML holds several stations.")
]
Out = Annotated[Path, typer.Option("--out", help="Output folder.", parser=_folder)]
DetectorName = Annotated[
    str | None,
    typer.Option("--detector", help="learned (default), analytic, learned-azimuth or learned-range."),
]
TrackerName = Annotated[str | None, typer.Option("--tracker", help="grid, bernoulli or focalization.")]
ConfigFile = Annotated[Path | None, typer.Option("--config", help="YAML file of parameters.")]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", help="One parameter, as section.key=value; repeatable.")
]
Start = Annotated[str | None, typer.Option("--start", help="ISO 8601 UTC start.")]
End = Annotated[str | None, typer.Option("--end", help="ISO 8601 UTC end.")]
Jobs = Annotated[
    int | None,
    typer.Option(
        "--jobs", min=1, callback=usable_cores, help="Threads or processes; all cores by default and at most."
    ),
]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress, no summary.")]
AisFile = Annotated[Path | None, typer.Option("--ais", help="AIS file, overlaid on what is drawn.")]
CalibrationFile = Annotated[Path | None, typer.Option("--calibration", help="File of `obsnet calibrate`.")]
Orientation = Annotated[
    float | None, typer.Option("--orientation", help="Azimuth of the first horizontal [deg].")
]
Polarity = Annotated[
    int | None, typer.Option("--hydrophone-polarity", help="1, or -1 for a reversed hydrophone.")
]
Depth = Annotated[
    float | None, typer.Option("--depth", help="Depth of the station [m], over the StationXML's.")
]
Latitude = Annotated[float | None, typer.Option("--latitude", help="Latitude [deg], over the StationXML's.")]
Longitude = Annotated[
    float | None, typer.Option("--longitude", help="Longitude [deg], over the StationXML's.")
]
PropagationFile = Annotated[
    Path | None, typer.Option("--propagation", help="netCDF table of delays, over the configured ocean.")
]


def main(arguments: list[str] | None = None) -> NoReturn:
    """Entry point: run a command, turn expected errors into one line and exit status 2."""
    # The compiled loops bring their own threads; a spinning BLAS pool on a shared CPU slows a run tenfold. Once numpy is
    # loaded this would reach child processes alone, and they would round otherwise than their parent.
    if "numpy" not in sys.modules:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="replace")
    command = typer.main.get_command(app)
    with warnings.catch_warnings(), console.stoppable(), console.caching():
        if not sys.warnoptions:
            warnings.simplefilter("ignore")
        try:
            code = command.main(args=arguments, prog_name="obsnet", standalone_mode=False)
            console.flush()
        except (KeyboardInterrupt, typer.Abort):
            sys.exit(130)
        except (BrokenPipeError, SystemExit) as leaving:
            # typer and rich leave with 1 when nobody reads the help any more
            if not any(isinstance(error, BrokenPipeError) for error in (leaving, leaving.__context__)):
                raise
            console.hush()
            sys.exit(0)
        except Exception as error:
            line = console.line_of(error)
            if line is None:
                raise
            print(f"obsnet: error: {line}", file=sys.stderr)
            sys.exit(2)
    sys.exit(code if isinstance(code, int) else 0)


@app.command()
def demo(
    out: Out = Path("demo-output"), detector: DetectorName = None, jobs: Jobs = None, quiet: Quiet = False
) -> None:
    """Run the main job on the bundled passage (simulated waveforms) and compare with its AIS."""
    from obsnet.sample import sample_folder

    folder = sample_folder()
    commands.track([str(folder / "waveforms.mseed")], folder / "station.xml", out, detector=detector, jobs=jobs, quiet=quiet,
           ais=folder / "ais.csv")  # fmt: skip
    commands.evaluate(out, folder / "ais.csv", quiet=quiet)


@app.command()
def track(
    waveforms: Waveforms,
    station: StationFile,
    out: Out,
    code: Code = None,
    detector: DetectorName = None,
    tracker: TrackerName = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    start: Start = None,
    end: End = None,
    ais: AisFile = None,
    calibration: CalibrationFile = None,
    propagation: PropagationFile = None,
    orientation: Orientation = None,
    hydrophone_polarity: Polarity = None,
    depth: Depth = None,
    latitude: Latitude = None,
    longitude: Longitude = None,
    jobs: Jobs = None,
    quiet: Quiet = False,
) -> None:
    """Waveforms to maps, detections, tracks and a report."""
    commands.track(
        waveforms, station, out, code=code, detector=detector, tracker=tracker, config=config, overrides=overrides,
        start=start, end=end, ais=ais, calibration=calibration, propagation=propagation, orientation=orientation,
        hydrophone_polarity=hydrophone_polarity, depth=depth, latitude=latitude, longitude=longitude, jobs=jobs, quiet=quiet,
    )  # fmt: skip


@app.command()
def detect(
    waveforms: Waveforms,
    station: StationFile,
    out: Out,
    code: Code = None,
    detector: DetectorName = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    start: Start = None,
    end: End = None,
    ais: AisFile = None,
    calibration: CalibrationFile = None,
    propagation: PropagationFile = None,
    orientation: Orientation = None,
    hydrophone_polarity: Polarity = None,
    depth: Depth = None,
    latitude: Latitude = None,
    longitude: Longitude = None,
    jobs: Jobs = None,
    quiet: Quiet = False,
) -> None:
    """Waveforms to maps and detections, without tracking."""
    commands.track(
        waveforms, station, out, code=code, detector=detector, config=config, overrides=overrides, start=start, end=end,
        ais=ais, calibration=calibration, propagation=propagation, orientation=orientation,
        hydrophone_polarity=hydrophone_polarity, depth=depth, latitude=latitude, longitude=longitude, jobs=jobs, quiet=quiet,
        tracking=False,
    )  # fmt: skip


@app.command()
def evaluate(
    folder: Annotated[Path, typer.Argument(help="Folder of `obsnet track`.")],
    ais: Annotated[Path, typer.Option("--ais", help="AIS file.")],
    max_cpa: Annotated[
        float, typer.Option("--max-cpa", help="Ships that come no closer [km] need not be found.")
    ] = 25.0,
    max_range: Annotated[
        float, typer.Option("--max-range", help="Ships are followed to this range [km].")
    ] = 100.0,
    merchant_only: Annotated[
        bool, typer.Option("--merchant-only", help="Cargo ships and tankers alone.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    quiet: Quiet = False,
) -> None:
    """Print the core paper's Table I for a run, against AIS."""
    limits = {"max_cpa_m": 1e3 * max_cpa, "max_range_m": 1e3 * max_range}
    commands.evaluate(folder, ais, quiet, as_json, merchant_only=merchant_only, **limits)


@app.command()
def calibrate(
    waveforms: Waveforms,
    station: StationFile,
    ais: Annotated[Path, typer.Option("--ais", help="AIS file of the passages to calibrate with.")],
    out: Out,
    code: Code = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    start: Start = None,
    end: End = None,
    depth: Depth = None,
    quiet: Quiet = False,
) -> None:
    """Orientation, hydrophone polarity, position and amplitudes from AIS passages."""
    from obsnet.calibration import calibrate_waveforms
    from obsnet.output import staged

    settings = commands.run_config(config, overrides, None, None)
    where = commands.read_station(station, code, depth_m=depth)
    where = commands.placed(where, waveforms, settings, start, end)
    reference = commands.read_reference(ais, where, max_cpa_m=None, quiet=quiet)
    with staged(out) as folder:
        with console.progress("calibrating", quiet) as progress:
            result = calibrate_waveforms(waveforms, where, reference, settings, start, end, progress)
        result.write(folder / "calibration.yaml")
    if not quiet:
        console.say(result.table())
        written = out / "calibration.yaml"
        console.say(f"written to {written}; use it with: obsnet track … --calibration {written}")


@app.command()
def simulate(
    out: Out,
    hours: Annotated[float, typer.Option("--hours", min=0.1, help="Length of the record.")] = 8.0,
    seed: Annotated[int, typer.Option("--seed", help="Seed of everything that is drawn.")] = 0,
    ships: Annotated[int, typer.Option("--ships", min=0, help="Ships drawn at random.")] = 1,
    ais: Annotated[
        Path | None, typer.Option("--ais", help="AIS file of the ships, in place of ships drawn at random.")
    ] = None,
    station: Annotated[
        Path | None, typer.Option("--station", help="StationXML whose position and depth to use.")
    ] = None,
    code: Code = None,
    start: Start = None,
    quiet: Quiet = False,
) -> None:
    """Simulate a record (miniSEED, StationXML, AIS, truth) with the twin."""
    from obsnet.twin.station import simulate_folder

    with console.progress("simulating", quiet) as progress:
        summary = simulate_folder(
            out, hours, seed, ships, ais, station=station, code=code, start=start, progress=progress
        )
    if not quiet:
        console.say(summary)


@app.command()
def fetch(
    target: Annotated[str, typer.Argument(metavar="NET.STA", help="Station to fetch.")],
    start: Annotated[str, typer.Option("--start", help="ISO 8601 UTC start.")],
    end: Annotated[str, typer.Option("--end", help="ISO 8601 UTC end.")],
    out: Out,
    base_url: Annotated[
        str | None, typer.Option("--base-url", help="FDSN data centre, by name or address.")
    ] = None,
    channels: Annotated[
        str | None, typer.Option("--channels", help="Channel codes, comma separated, wildcards allowed.")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Fetch waveforms and metadata from an FDSN data centre into an SDS archive; resumes where it stopped."""
    from obsnet.fdsn import fetch as fetch_archive

    options: dict[str, Any] = {}
    if base_url:
        options["base_url"] = base_url
    if channels:
        options["channels"] = tuple(part.strip() for part in channels.split(","))
    with console.progress("fetching", quiet) as progress:
        report = fetch_archive(target, start, end, out, progress=progress, **options)
    if not quiet:
        console.say(str(report))


@app.command()
def watch(
    source: Annotated[
        str,
        typer.Argument(help="seedlink://HOST:PORT/NET.STA, a folder, or - for miniSEED on standard input."),
    ],
    station: StationFile,
    out: Out,
    code: Code = None,
    detector: DetectorName = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    latency: Annotated[
        float | None, typer.Option("--latency", help="How late a packet may come and be used [s].")
    ] = None,
    calibration: CalibrationFile = None,
    propagation: PropagationFile = None,
    orientation: Orientation = None,
    hydrophone_polarity: Polarity = None,
    depth: Depth = None,
    latitude: Latitude = None,
    longitude: Longitude = None,
    once: Annotated[bool, typer.Option("--once", help="End when there is nothing more.")] = False,
    check: Annotated[bool, typer.Option("--check", help="Check everything, and end.")] = False,
    quiet: Quiet = False,
) -> None:
    """Keep detections and tracks up to date with waveforms as they come, unattended."""
    commands.watch(
        source, station, out, code=code, detector=detector, config=config, overrides=overrides, latency=latency,
        calibration=calibration, propagation=propagation, orientation=orientation,
        hydrophone_polarity=hydrophone_polarity, depth=depth, latitude=latitude, longitude=longitude, once=once, check=check,
        quiet=quiet,
    )  # fmt: skip


@app.command()
def archive(
    waveforms: Annotated[Path, typer.Argument(metavar="SDS", help="SDS archive of waveforms.")],
    stations: Annotated[
        list[Path], typer.Option("--stations", help="StationXML file or folder; repeatable.")
    ],
    start: Annotated[str, typer.Option("--start", help="First UTC date.")],
    end: Annotated[str, typer.Option("--end", help="UTC date after the last.")],
    out: Out,
    select: Annotated[
        str | None, typer.Option("--select", help="NET.STA, comma separated, wildcards allowed.")
    ] = None,
    detector: DetectorName = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    jobs: Jobs = None,
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", help="Address of a Dask scheduler, over own processes.")
    ] = None,
    quiet: Quiet = False,
) -> int:
    """Detect and track many station-days of an SDS archive; resumes where it stopped, status 3 if a day failed."""
    return commands.archive(
        waveforms, stations, start, end, out, select=select, detector=detector, config=config, overrides=overrides, jobs=jobs,
        scheduler=scheduler, quiet=quiet,
    )  # fmt: skip


@app.command()
def serve(
    folder: Annotated[Path, typer.Argument(help="Folder of `obsnet track` or of `obsnet watch`.")],
    host: Annotated[str, typer.Option("--host", help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port; 0 for any free one.")] = 8080,
    ais: AisFile = None,
) -> None:
    """Show a folder's tracks and maps as a page in the browser; read-only."""
    commands.serve(folder, host, port, ais)


bench = typer.Typer(
    help="What obsnet costs on this machine.", context_settings={"help_option_names": ["-h", "--help"]}
)
app.add_typer(bench, name="bench")


@bench.callback()
def _bench() -> None:
    """What obsnet costs on this machine."""


@bench.command("station")
def bench_station(
    detector: DetectorName = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Milliseconds a minute of data, resident memory and cold start of a live station."""
    from obsnet.live.bench import station_cost

    cost = station_cost(detector)
    console.say(json.dumps(cost.to_json()) if as_json else cost.table())


EXPERIMENTS = ("table1", "tkbd", "bearings", "clicks", "focalization")


@app.command()
def reproduce(
    name: Annotated[str, typer.Argument(help=", ".join(EXPERIMENTS))],
    runs: Annotated[int | None, typer.Option("--runs", min=1, help="Monte Carlo runs.")] = None,
    seed: Annotated[int, typer.Option("--seed")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    out: Annotated[Path | None, typer.Option("--out", help="Folder for the figure.")] = None,
    detector: Annotated[
        str | None,
        typer.Option(
            "--detector",
            help="Of table1: learned (default), analytic, learned-azimuth, learned-range or all.",
        ),
    ] = None,
    jobs: Jobs = None,
    quiet: Quiet = False,
) -> None:
    """Repeat a paper's experiment; prints its numbers beside obsnet's."""
    import importlib

    from obsnet.output import staged

    if name not in EXPERIMENTS:
        raise ConfigError(f"no experiment '{name}'; choose one of {', '.join(EXPERIMENTS)}")
    experiment = importlib.import_module(f"obsnet.experiments.{name}")
    options: dict[str, Any] = {"seed": seed, "jobs": jobs}
    if runs is not None:
        options["runs"] = runs
    if detector is not None:
        if name != "table1":
            raise ConfigError(f"experiment {name} has no detectors to choose from; leave --detector out")
        options["detector"] = detector
    with ExitStack() as whole:
        folder = whole.enter_context(staged(out)) if out is not None else None
        with console.progress(name, quiet or as_json) as progress:
            result = experiment.reproduce(progress=progress, **options)
        if folder is not None:
            result.plot(folder / f"{name}.png")
    if as_json:
        console.say(json.dumps(result.to_json()))
    elif not quiet:
        table = result.table()
        console.say(table if isinstance(table, str) else "\n".join(map(str, table)))


@app.command()
def plot(
    folder: Annotated[Path, typer.Argument(help="Folder of `obsnet track`.")],
    figure: Annotated[
        int | None, typer.Option("--figure", help="The core paper's figure 3, 5, 6, 7 or 8 (all by default).")
    ] = None,
    ais: AisFile = None,
    quiet: Quiet = False,
) -> None:
    """Draw the core paper's figures from any run."""
    from obsnet.plots import FIGURES, draw

    if figure is not None and figure not in FIGURES:
        raise ConfigError(f"no figure {figure}; choose one of {', '.join(map(str, FIGURES))}")
    for path in draw(folder, [figure] if figure else list(FIGURES), ais):
        if not quiet:
            console.say(str(path))


models = typer.Typer(help="What a learned detector's file is, and whether it can be trusted.")
app.add_typer(models, name="model")
ModelPath = Annotated[Path, typer.Argument(help="ONNX file.")]


@models.command("info")
def model_info(
    file: ModelPath, as_json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False
) -> None:
    """Say what a model's card says: task, representation, calibration, metrics, and where it comes from."""
    commands.model_info(file, as_json)


@models.command("verify")
def model_verify(file: ModelPath) -> None:
    """Check a model's size, digest, operators, card and shapes, load it and run it once."""
    commands.model_verify(file)


@app.command()
def version() -> None:
    """Print the version."""
    import obsnet

    console.say(obsnet.__version__)
