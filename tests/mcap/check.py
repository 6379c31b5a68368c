"""Judges episodes with foreign programs: the `mcap` package, Foxglove's published schemas, and Rerun.

    check.py RERUN FILE...

Prints a line for each point. Ends with 1 at the first that does not hold.
"""

import math
import pathlib
import re
import subprocess
import sys
import tempfile

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

# Seconds of Unix time before which no episode can be: the start of 2020.
YEAR_2020_S = 1_577_836_800
TOPICS = {"/camera/image/compressed", "/camera/annotations", "/feature", "/telemetry", "/sample"}
# Columns that must arrive in Rerun as numbers.
NUMBERS = ["/telemetry", "alpha_deg"], ["/telemetry", "poured_ml"], ["/sample", "area_px2"], ["/feature", "confidence"]


def holds(what, condition):
    print(("ok    " if condition else "FAILS ") + what, flush=True)
    if not condition:
        sys.exit(1)


def same_fields(ours, published):
    """Faults of a schema in the file against the one that Foxglove publishes, messages inside included."""
    theirs = published.fields_by_name
    for name, field in ours.fields_by_name.items():
        other = theirs.get(name)
        if other is None or (field.number, field.type) != (other.number, other.type):
            yield f"{ours.full_name}.{name}"
        elif field.message_type is not None and field.message_type.full_name.startswith("foxglove."):
            yield from same_fields(field.message_type, other.message_type)


def check_messages(file):
    topics, last, orders, doubles = set(), 0, 0, 0
    spans = []
    with open(file, "rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()], validate_crcs=True)
        for _, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False):
            topics.add(channel.topic)
            orders += message.log_time < last
            last = message.log_time
            spans.append(message.log_time)
            if channel.topic == "/camera/annotations":
                faults = list(same_fields(decoded.DESCRIPTOR, ImageAnnotations.DESCRIPTOR))
                doubles += len(faults)
                ImageAnnotations.FromString(message.data)
            if channel.topic == "/camera/image/compressed":
                doubles += len(list(same_fields(decoded.DESCRIPTOR, CompressedImage.DESCRIPTOR)))
                holds_time = decoded.timestamp.seconds * 10**9 + decoded.timestamp.nanos
                doubles += holds_time != message.log_time
            if channel.topic == "/telemetry":
                doubles += not (isinstance(decoded.dalpha_deg, float) and math.isfinite(decoded.alpha_deg))
        metadata = {m.name for m in reader.iter_metadata()}
    holds(f"{file.name}: every message is read by its own schema; topics {sorted(topics)}", topics == TOPICS)
    holds(f"{file.name}: Foxglove's messages are the published ones, and image times are log times", doubles == 0)
    holds(f"{file.name}: {len(spans)} messages in the order of their times", orders == 0)
    holds(f"{file.name}: log times are Unix time", min(spans) / 1e9 > YEAR_2020_S)
    holds(f"{file.name}: metadata {sorted(metadata)}", {"episode", "config", "end"} <= metadata)


def check_rerun(rerun, file):
    done = subprocess.run([rerun, "mcap", "check", "--full", str(file)], capture_output=True, text=True, check=False)
    lines = [line for line in done.stdout.splitlines() if "/" in line and ("ok" in line.split() or "—" in line)]
    print(done.stdout)
    holds(f"{file.name}: rerun mcap check has nothing to say (exit code {done.returncode})", done.returncode == 0 and len(lines) >= len(TOPICS))
    with tempfile.TemporaryDirectory() as folder:
        rrd = pathlib.Path(folder) / "episode.rrd"
        subprocess.run([rerun, "mcap", "convert", str(file), "-o", str(rrd)], capture_output=True, check=True)
        printed = subprocess.run([rerun, "rrd", "print", "-vv", str(rrd)], capture_output=True, text=True, check=True).stdout
        for topic, name in NUMBERS:
            column = re.search(f'"{name}": (non-null )?(Float32|Float64)', printed)
            holds(f"{file.name}: Rerun has {topic} {name} as a number", topic in printed and column is not None)


def main():
    rerun = sys.argv[1]
    for file in map(pathlib.Path, sys.argv[2:]):
        check_messages(file)
        check_rerun(rerun, file)


if __name__ == "__main__":
    main()
