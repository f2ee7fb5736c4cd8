"""Kernels and gravity files: what they say, and what is refused."""

import sys
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scp_recon.bodies.catalogue import DAY_S, J2000_TDB
from scp_recon.bodies.files import read_gravity
from scp_recon.bodies.kernels import read_dsk, read_heliocentric, read_pck
from scp_recon.bodies.surface import Mesh, direction_of
from scp_recon.errors import InputError
from scp_recon.physics.frames import Rotation
from scp_recon.scenario.load import validate_scenario
from tests.scp_recon.bodies.test_surface import box
from tests.scp_recon.support import refusal

ROCK_ID = 2_999_999
PCK = f"""KPL/PCK
\\begindata
BODY{ROCK_ID}_POLE_RA = ( 85.5 0. 0. )
BODY{ROCK_ID}_POLE_DEC = ( -60.4 0. 0. )
BODY{ROCK_ID}_PM = ( 140.7 2011.1 1.8E-06 )
BODY{ROCK_ID}_RADII = ( 0.28 0.27 0.25 )
\\begintext
"""
DAYS = 7_325.3
ROCK = box(np.array([280.0, 270.0, 250.0]))


def write_pck(path: Path, text: str = PCK) -> Path:
    path.write_text(text, "utf-8")
    return path


def write_spk(path: Path, spice: Any) -> tuple[Path, Any]:
    """A body on a circle about the Sun for some days; and its states, km."""
    et = DAYS * DAY_S + np.linspace(-3.0, 3.0, 25) * DAY_S
    angle, rate = 1e-7 * et, 1e-7
    circle = np.stack([np.cos(angle), np.sin(angle), 0.1 * np.cos(angle)], axis=1)
    moving = np.stack([-np.sin(angle), np.cos(angle), -0.1 * np.sin(angle)], axis=1)
    states = 1.5e8 * np.concatenate([circle, rate * moving], axis=1)
    handle = spice.spkopn(str(path), "test", 0)
    spice.spkw13(handle, ROCK_ID, 10, "J2000", et[0], et[-1], "rock", 7, len(et), states, et)
    spice.spkcls(handle)
    return path, states


def write_dsk(path: Path, mesh: Mesh, spice: Any, segments: int = 1) -> Path:
    vertices, plates = mesh.vertices_m / 1e3, mesh.facets + 1
    finscl, corscl, worksz, voxpsz, voxlsz, spxisz = 5.0, 4, 10_000, 2_000, 5_000, 200_000
    spaixd, spaixi = spice.dskmi2(
        vertices, plates, finscl, corscl, worksz, voxpsz, voxlsz, True, spxisz
    )
    pi = np.pi
    low, high = spice.dskrb2(vertices, plates, 1, np.zeros(10))
    handle = spice.dskopn(str(path), "test", 0)
    for surface in range(1, segments + 1):
        spice.dskw02(
            *(handle, ROCK_ID, surface, 1, "J2000", 1, np.zeros(10)),
            *(-pi, pi, -pi / 2, pi / 2, low, high, -1e9, 1e9, vertices, plates, spaixd, spaixi),
        )
    spice.dskcls(handle, True)
    return path


def test_dsk_of_other_or_several_shapes_refused(tmp_path, spice):
    one = write_dsk(tmp_path / "one.bds", ROCK, spice)
    assert len(read_dsk(one, ROCK_ID)[1]) == len(ROCK.facets)
    with pytest.raises(InputError, match=f"must be of body {ROCK_ID + 1}"):
        read_dsk(one, ROCK_ID + 1)
    with pytest.raises(InputError, match="of several segments"):
        read_dsk(write_dsk(tmp_path / "two.bds", ROCK, spice, segments=2), ROCK_ID)


@pytest.mark.usefixtures("spice")
def test_meta_kernel_is_read_from_its_own_folder(tmp_path):
    """As an export writes it, from wherever the program runs."""
    file = write_pck(tmp_path / "rock.tpc")
    words = "PATH_VALUES=('.')\nPATH_SYMBOLS=('HERE')\nKERNELS_TO_LOAD=('$HERE/rock.tpc')\n"
    listed = tmp_path / "all.tm"
    listed.write_text(f"KPL/MK\n\\begindata\n{words}", "utf-8")
    assert read_pck(listed, ROCK_ID, DAYS) == read_pck(file, ROCK_ID, DAYS)


def test_the_rotation_of_a_pck_is_spices(tmp_path, spice):
    file = write_pck(tmp_path / "rock.tpc")
    found = read_pck(file, ROCK_ID, DAYS)
    assert found.radii_m == pytest.approx((280.0, 270.0, 250.0))
    epoch = J2000_TDB + timedelta(days=DAYS)
    ours = Rotation.from_iau(found.pole_ra_deg, found.pole_dec_deg, found.prime_meridian, epoch)
    with spice.KernelPool(str(file)):
        for seconds in (0.0, 20_000.0):
            theirs = spice.tipbod("J2000", ROCK_ID, DAYS * DAY_S + seconds).T
            np.testing.assert_allclose(ours.body_to_j2000(seconds), theirs, atol=1e-8)


def test_spk_states_are_those_written(tmp_path, spice):
    file, states = write_spk(tmp_path / "rock.bsp", spice)
    position, velocity = read_heliocentric([file], ROCK_ID, DAYS * DAY_S)
    np.testing.assert_allclose([*position, *velocity], states[12], rtol=1e-12)


@pytest.mark.parametrize(("latitude", "longitude"), [(10.0, 20.0), (-70.0, 100.0), (40.0, -130.0)])
def test_rays_meet_a_dsk_where_spice_says(latitude, longitude, tmp_path, spice):
    file = write_dsk(tmp_path / "rock.bds", ROCK, spice)
    vertices, facets = read_dsk(file)
    direction = direction_of(latitude, longitude)
    position, normal = Mesh(vertices, facets).at(direction)
    with spice.KernelPool(str(file)):
        handle = spice.kdata(0, "dsk")[3]
        segment = spice.dlabfs(handle)
        plate, point, found = spice.dskx02(handle, segment, 2.0 * direction, -direction)
        assert found
        np.testing.assert_allclose(position, point * 1e3, rtol=1e-9)
        np.testing.assert_allclose(normal, spice.dskn02(handle, segment, plate), atol=1e-12)


def test_a_scenario_by_kernels_needs_them_once(tmp_path, spice):
    write_pck(tmp_path / "rock.tpc")
    write_spk(tmp_path / "rock.bsp", spice)
    write_dsk(tmp_path / "rock.bds", ROCK, spice)
    body = {"name": "Rock", "naif_id": ROCK_ID, "gm_m3_s2": 5.0, "j2": 0.0}
    body |= {"pck_file": str(tmp_path / "rock.tpc"), "shape_file": str(tmp_path / "rock.bds")}
    found = validate_scenario(
        {
            "base": "recon_b",
            "epoch": {"tdb": (J2000_TDB + timedelta(days=DAYS)).isoformat()},
            "body": body | {"reference_radius_m": 290.0},
            "sun": {"spk_files": [str(tmp_path / "rock.bsp")]},
            "site": {"name": "Top", "latitude_deg": 90.0, "longitude_deg": 0.0},
        }
    )
    assert found.body.prime_meridian_rate_deg_day == 2011.1
    assert found.site.position_body_m[2] == pytest.approx(250.0)
    for file in tmp_path.iterdir():
        file.unlink()
    assert found.replace({"risk.p_chance": 0.8}).sun == found.sun


@pytest.mark.slow
def test_threads_read_kernels_as_one_does(tmp_path, spice):
    """SPICE has one state for all threads of a process, which die or get another's kernels."""
    file, states = write_spk(tmp_path / "rock.bsp", spice)
    folders = [tmp_path / str(number) for number in range(6)]
    for number, folder in enumerate(folders):
        folder.mkdir()
        write_pck(folder / "rock.tpc", PCK.replace("2011.1", f"{number}.5"))

    def read(number: int) -> tuple[float, list[float]]:
        pck = read_pck(folders[number % 6] / "rock.tpc", ROCK_ID, DAYS)
        return pck.prime_meridian[1], read_heliocentric([file], ROCK_ID, DAYS * DAY_S)[0]

    with ThreadPoolExecutor(6) as threads:
        found = list(threads.map(read, range(300)))
    assert [rate for rate, _ in found] == [number % 6 + 0.5 for number in range(300)]
    np.testing.assert_allclose([place for _, place in found], [states[12, :3]] * 300, rtol=1e-12)
    assert spice.ktotal("all") == 0


def test_kernels_at_long_paths_are_read(tmp_path, spice):
    folder = tmp_path / ("a deep folder " * 9).strip() / ("another " * 20).strip()
    folder.mkdir(parents=True)
    assert len(str(folder)) > 300
    pck = write_pck(folder / "rock.tpc")
    found = read_pck(pck, ROCK_ID, DAYS).prime_meridian
    assert found == pytest.approx((140.7, 2011.1, 1.8e-6))
    for name in ("rock.bsp", "rock.bds"):
        write = write_spk if name == "rock.bsp" else partial(write_dsk, mesh=ROCK)
        write(tmp_path / name, spice=spice)
        (tmp_path / name).rename(folder / name)
    assert len(read_dsk(folder / "rock.bds", ROCK_ID)[1]) == len(ROCK.facets)
    here = Path.cwd()
    assert read_heliocentric([folder / "rock.bsp"], ROCK_ID, DAYS * DAY_S)[0]
    with pytest.raises(InputError, match=f"rock.bsp has {ROCK_ID} from "):
        read_heliocentric([folder / "rock.bsp"], ROCK_ID, (DAYS + 9.0) * DAY_S)
    assert Path.cwd() == here


@pytest.mark.usefixtures("spice")
def test_a_missing_kernel_of_a_list_is_named(tmp_path):
    listed = tmp_path / "all.tm"
    listed.write_text("KPL/MK\n\\begindata\nKERNELS_TO_LOAD = ( 'gone.bsp' )\n", "utf-8")
    with pytest.raises(InputError, match=r"gone\.bsp' specified by KERNELS_TO_LOAD"):
        read_pck(listed, ROCK_ID, DAYS)


def test_the_users_own_kernels_stay(tmp_path, spice):
    mine = write_pck(tmp_path / "mine.tpc", PCK.replace("2011.1", "100.0"))
    with spice.KernelPool(str(mine)):
        read_pck(write_pck(tmp_path / "rock.tpc"), ROCK_ID, DAYS)
        assert spice.bodvcd(ROCK_ID, "PM", 3)[1][1] == 100.0
        assert spice.ktotal("all") == 1


def refusals(path: Path) -> list[InputError]:
    return [
        refusal(read_pck, path, ROCK_ID, DAYS),
        refusal(read_heliocentric, [path], ROCK_ID, DAYS * DAY_S),
        refusal(read_dsk, path),
    ]


@pytest.mark.parametrize("text", [None, "", "no kernel\n", "KPL/PCK\n\\begindata\nX = 1\n"])
def test_what_is_no_kernel_is_refused(text, tmp_path, spice):
    assert spice.ktotal("all") == 0
    path = tmp_path / "no.tpc"
    if text is not None:
        path.write_text(text, "utf-8")
    entries = [error.entry for error in refusals(path)]
    assert entries == ["body.pck_file", "sun.spk_files", "body.shape_file"]


def test_epoch_that_kernels_do_not_cover_is_refused(tmp_path, spice):
    """The file and its span are told, where it ends five minutes early, too."""
    file, _ = write_spk(tmp_path / "rock.bsp", spice)
    last = J2000_TDB + timedelta(days=DAYS + 3.0)
    for late_s in (300.0, 50.0 * DAY_S):
        with pytest.raises(InputError, match="at the epoch") as caught:
            read_heliocentric([file], ROCK_ID, (DAYS + 3.0) * DAY_S + late_s)
        assert f"rock.bsp has {ROCK_ID} from " in caught.value.given
        assert f"to {last.isoformat()[:19]} TDB" in caught.value.given
        asked = last + timedelta(seconds=late_s)
        assert asked.isoformat()[:19] in caught.value.allowed


def test_without_spiceypy_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "spiceypy", None)
    for error in refusals(write_pck(tmp_path / "rock.tpc")):
        assert "scp_recon[spice]" in error.allowed


ROWS = ((2, 0, -0.0192, 0.0), (2, 2, 0.003, -0.001), (3, 1, 8e-4, -5e-4))
GFC = """comment of the head: 1 2 3
product_type gravity_field
earth_gravity_constant 4.89D+00
radius 290.0
max_degree 3
norm fully_normalized
key L M C S
end_of_head =====
gfc 0 0 1.0 0.0
gfc 2 0 -0.0192 0.0 1e-9 1e-9
gfc 2 1 0.0 0.0
gfc 2 2 3.0d-3 -1.0d-3
gfc 3 1 8e-4 -5e-4
"""
SHA = """ 0.29, 4.89E-09, 0.0, 3, 3, 1, 0.0, 0.0
 2, 0, -0.0192, 0.0, 1e-9, 0.0
 2, 1, 0.0, 0.0, 0.0, 0.0
 2, 2, 3.0E-03, -1.0E-03, 0.0, 0.0
 3, 1, 8.0E-04, -5.0E-04, 0.0, 0.0
"""
BARE = "\n".join(f"  {n}  {m} {c:.5E} {s:.5E} 0.0 0.0" for n, m, c, s in ROWS)


def written(folder: Path, text: str) -> Path:
    file = folder / "field.txt"
    file.write_text(text, "utf-8")
    return file


@pytest.mark.parametrize("text", [GFC, SHA], ids=["gfc", "sha"])
def test_both_formats_say_the_same(text, tmp_path):
    table = read_gravity(written(tmp_path, text), 20)
    assert table.gm_m3_s2 == pytest.approx(4.89)
    assert table.radius_m == pytest.approx(290.0)
    assert table.rows == ROWS
    assert read_gravity(written(tmp_path, text), 2).rows == ROWS[:2]


def test_bare_table_has_neither_gm_nor_radius(tmp_path):
    table = read_gravity(written(tmp_path, BARE), 20)
    assert (table.gm_m3_s2, table.radius_m, table.rows) == (None, None, ROWS)


@pytest.mark.parametrize(
    "text",
    [
        *("", "nonsense", "1 2 3", "end_of_head\n", "0 0 1 0\n", GFC + "gfc 2 0 0.1 0.0\n"),
        *(GFC.replace("fully_", "un"), GFC.replace("gfc 3 1", "gfct 3 1")),
        *(GFC.replace("gfc 3 1", "gfc 3 4"), GFC.replace("gfc 2 1 0.0", "gfc 1 1 0.1")),
        *(GFC.replace("0 0 1.0", "0 0 2.0"), SHA.replace("3, 1, 0.0", "3, 0, 0.0")),
        *(SHA.replace("-0.0192", number) for number in ("-19.2", "nan")),
    ],
)
def test_unnormalised_fields_are_refused_in_one_message(text, tmp_path):
    error = refusal(read_gravity, written(tmp_path, text), 20)
    assert error.entry.startswith("body.gravity_file")
