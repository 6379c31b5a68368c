"""Makes empty stand-ins for the CUDA libraries that PyTorch's package names but a machine without a GPU never calls.

PyTorch's package on PyPI is built for CUDA, and its libraries are four gigabytes. The loader wants them to be there and to have the names;
nothing is called. Each stand-in has the names that PyTorch's own files leave open, and nothing behind them: a call ends the process.

    stand_ins.py SITE_PACKAGES
"""

import pathlib
import re
import subprocess
import sys

# Each library that is stood in for, and how its names begin.
LIBRARIES = {
    "libcusparse.so.12": "cusparse(?!Lt)",
    "libcusparseLt.so.0": "cusparseLt",
    "libcufft.so.12": "cufft",
    "libcufile.so.0": "cuFile",
    "libnccl.so.2": "(p?nccl)",
    "libcurand.so.10": "curand",
    "libcublas.so.13": "cublas(?!Lt)",
    "libcublasLt.so.13": "cublasLt",
    "libcudnn.so.9": "cudnn",
    "libcusolver.so.12": "cusolver",
    "libnvshmem_host.so.3": "nvshmem",
}


def open_names(library):
    """Names that `library` leaves open, each with its version or an empty text."""
    text = subprocess.run(["nm", "-D", "--undefined-only", library], capture_output=True, text=True, check=True).stdout
    for line in text.splitlines():
        name, _, version = line.split()[-1].partition("@")
        yield name, version.lstrip("@")


def make(folder, soname, names):
    """Writes the stand-in `soname` with `names` into `folder`."""
    source = "".join(f"void {name}(void) {{ __builtin_trap(); }}\n" for name, _ in names)
    versions = {}
    for name, version in names:
        versions.setdefault(version, []).append(name)
    script = "".join(f"{v} {{ {' '.join(n + ';' for n in members)} }};\n" for v, members in versions.items() if v)
    map_file = folder / f".{soname}.map"
    map_file.write_text(script)
    command = ["cc", "-w", "-shared", "-fPIC", "-fno-builtin", "-x", "c", "-", f"-Wl,-soname,{soname}", "-o", str(folder / soname)]
    if script:
        command.append(f"-Wl,--version-script={map_file}")
    subprocess.run(command, input=source, text=True, check=True)
    map_file.unlink()


def main():
    # These two are small, and are called when PyTorch is loaded: they are the real ones.
    torch = pathlib.Path(sys.argv[1]) / "torch" / "lib"
    for real in ("libcudart.so.13", "libcupti.so.13"):
        (torch / real).unlink(missing_ok=True)
        (torch / real).symlink_to(pathlib.Path(sys.argv[1]).resolve() / "nvidia" / "cu13" / "lib" / real)
    names = {name for library in sorted(torch.glob("*.so")) if library.name not in LIBRARIES for name in open_names(library)}
    for soname, pattern in LIBRARIES.items():
        make(torch, soname, sorted(n for n in names if re.match(pattern, n[0])))


if __name__ == "__main__":
    main()
