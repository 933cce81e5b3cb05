"""The walls of the house: layers, siblings and cycles, lazy imports included, read from the source and not from a run."""

from __future__ import annotations

from fnmatch import fnmatch

import pytest
from import_graph import MODULES, PACKAGE, ROOT, edges, imports_of, package_of, read

# Top may import below; packages on one line are siblings and never import each other.
LAYERS = [
    ["cli"],
    ["studies"],
    ["pipeline"],
    ["osm", "odometry"],
    ["backend", "reports"],
    ["simulation", "evaluation"],
    ["io", "maps"],
    ["registration"],
    ["core"],
]
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}
# Rooms in a room, likewise; "" are the modules that lie in it directly. Kernels are at the bottom of each.
INNER = {
    "pipeline": [["deliver"], ["convert"], [""], ["doctor"]],
    "odometry": [["frontend"], [""], ["inertial", "integrity"]],
    "backend": [["", "localization"], ["graph", "loops"], ["keyframes"]],
    "io": [["readers"], ["formats"], [""]],
    "registration": [[""], ["preprocessing"]],
    "core": [["types"], ["geometry"], ["config", "kernels"], [""]],
}

# The one home of each heavy or foreign library.
HOMES = {
    "gtsam": ["backend/graph/*"],
    "rosbags": ["io/formats/bag_files.py", "pipeline/convert/bag_writer.py"],
    "ruamel": ["io/formats/bag_listing.py"],
    "laspy": ["io/formats/las_files.py"],
    "small_gicp": ["odometry/small_gicp.py"],
    "rerun": ["reports/*"],
    "kiss_icp": ["odometry/kiss.py"],
    "embreex": ["simulation/scene_mesh.py"],
    "open3d": ["maps/*", "odometry/open3d.py"],
    "requests": ["osm/overpass.py"],
    "urllib3": ["osm/overpass.py"],
    "pyproj": ["core/geometry/geodesy.py", "maps/georeference.py"],
    "fsspec": ["io/remote.py"],
    "fastkml": ["pipeline/convert/convert_trajectory.py"],
    "pygeoif": ["pipeline/convert/convert_trajectory.py"],
    "fudgeo": ["pipeline/convert/to_gpkg.py"],
    "gpxpy": ["pipeline/convert/convert_trajectory.py"],
    "dask": ["studies/cluster.py"],
    "distributed": ["studies/cluster.py"],
    "pyarrow": ["studies/results_csv.py"],
    "numba": ["*/kernels/*"],
    "matplotlib": ["reports/*"],
}


def level_within(name: str) -> tuple[int, str]:
    """Of the room in a room: its level, counted downwards, and its name."""
    _, room, *rest = name.split(".")
    levels = INNER.get(room, [[""]])
    inner = rest[0] if rest and rest[0] in {"kernels"}.union(*levels) else ""
    return next((level for level, names in enumerate(levels) if inner in names), len(levels)), inner


def test_every_package_has_a_layer() -> None:
    unknown = {package_of(m) for m in MODULES} - set(LEVEL) - {"", "__main__"}
    assert not unknown, f"no layer for {unknown}"


def test_imports_go_down() -> None:
    wrong = []
    for importer, imported in edges():
        a, b = package_of(importer), package_of(imported)
        if a in ("", "__main__") or b == "":
            continue
        if a == b:
            below, above = level_within(imported), level_within(importer)
            is_up = below[0] < above[0] or (below[0] == above[0] and below[1] != above[1])
        else:
            is_up = LEVEL[b] <= LEVEL[a]
        if is_up:
            wrong.append(f"{importer} -> {imported}")
    assert not wrong, wrong


def test_no_module_imports_the_face_of_the_package() -> None:
    """`import lslam` inside lslam would tie everything to everything."""
    wrong = [m for m, p in MODULES.items() if "lslam" in {i for i in imports_of(p) if "." not in i}]
    assert not wrong, wrong


def test_no_import_cycles() -> None:
    graph: dict[str, set[str]] = {name: set() for name in MODULES}
    for importer, imported in edges():
        # `from package import module` names the package too; its face importing its own rooms is no cycle.
        if not importer.startswith(imported + ".") and importer != "lslam":
            graph[importer].add(imported)
    state: dict[str, int] = {}

    def visit(node: str, trail: list[str]) -> None:
        state[node] = 1
        for child in sorted(graph[node]):
            if state.get(child) == 1:
                pytest.fail("cycle: " + " -> ".join([*trail, node, child]))
            if child not in state:
                visit(child, [*trail, node])
        state[node] = 2

    for name in MODULES:
        if name not in state:
            visit(name, [])


def test_foreign_libraries_have_one_home() -> None:
    wrong = []
    for name, path in MODULES.items():
        relative = path.relative_to(PACKAGE).as_posix()
        for target in {i.split(".")[0] for i in imports_of(path)}:
            if target in HOMES and not any(fnmatch(relative, home) for home in HOMES[target]):
                wrong.append(f"{name} imports {target}")
    assert not wrong, wrong


def test_class_names_are_unique() -> None:
    """A reader who searches for a class finds one."""
    homes: dict[str, list[str]] = {}
    for name, path in MODULES.items():
        for found in read(path)[2]:
            homes.setdefault(found, []).append(name)
    wrong = {name: places for name, places in homes.items() if len(places) > 1}
    assert not wrong, wrong


def test_kernels_import_nothing_of_lslam_but_kernels_and_types_of_arrays() -> None:
    wrong = [
        f"{name} -> {target}"
        for name, path in MODULES.items()
        if ".kernels" in name
        for target in imports_of(path)
        if target.startswith("lslam") and ".kernels" not in target and not target.startswith("lslam.core.arrays")
    ]
    assert not wrong, wrong


def test_files_stay_small() -> None:
    long = {str(p.relative_to(ROOT)): n for p in MODULES.values() if (n := len(p.read_text().splitlines())) > 400}
    assert not long, long
