"""CONTHASH: every word, column and pixel that is read, changed one at a time with new checksums, is noticed."""

from __future__ import annotations

import dataclasses
import io
import re
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from calibration_in_words import changed as with_other
from calibration_in_words import contents
from same_record import assert_same
from test_other_products import product_of

from walop_jax.calibration.calibration import UNCHECKED
from walop_jax.calibration.certify import certify
from walop_jax.calibration.product import content_of, read_calibration, write_calibration
from walop_jax.data.calset import read_calibration_set
from walop_jax.fit.verdict import Hidden, Structure, UndetectedError
from walop_jax.io.errors import DataError

OF_FITS = re.compile(
    "SIMPLE|BITPIX|NAXIS|EXTEND|XTENSION|PCOUNT|GCOUNT|TFIELDS|EXTNAME|CHECKSUM|DATASUM|BSCALE|BZERO|BLANK|"
    r"(NAXIS|TTYPE|TFORM)\d+"
)
"""Words of the structure of FITS: what they say of the data is seen in these."""
APART = re.compile(r"DATE|CREATOR|SOFT\d+")
"""Words that say when and by what a product was made."""
EARLIER = Path(__file__).with_name("product_of_an_earlier_rule.fits.gz")


@pytest.fixture
def path(two_cameras, tmp_path):
    """A product with everything that a product may hold."""
    product = product_of(read_calibration_set(two_cameras.write()), 2, {"HWP": 22.5})
    mistakes = UndetectedError("scale of X and Y", 0.02, ""), UndetectedError("pedestal", 1.5, "electron")
    hidden = Hidden(mistakes, np.arange(4.0).reshape(2, 2))
    verdict = dataclasses.replace(product.verdict, structure=Structure(1e-4, 2e-5))
    full = with_other(product, hidden=hidden, verdict=verdict)
    write_calibration(tmp_path / "whole.fits", full)
    return tmp_path / "whole.fits"


def changed(path: Path, change) -> Path:
    """A copy of a product with a change and new checksums."""
    with fits.open(io.BytesIO(path.read_bytes())) as hdus:
        change(hdus)
        hdus.writeto(path.with_name("changed.fits"), checksum=True, overwrite=True)
    return path.with_name("changed.fits")


def other(value):
    """Another value of its kind."""
    if isinstance(value, bool | np.bool_):
        return not value
    if isinstance(value, str):
        return f"{value[:-1]}!"
    return value + 1 if np.isfinite(value) else 1.0


def words(path: Path) -> list[tuple[int, str]]:
    """Extensions and words of a file."""
    with fits.open(path) as hdus:
        return [
            (n, str(word)) for n, hdu in enumerate(hdus) for word in hdu.header if not OF_FITS.fullmatch(word)
        ]


def refused(path: Path) -> bool:
    try:
        read_calibration(path, any_model=True)
    except DataError:
        return True
    return False


def test_words(path):
    """Words in memory: the reader refuses a file whose hash is another one."""
    with fits.open(path) as hdus:
        held = hdus[0].header["CONTHASH"]
        for hdu in hdus:
            # Only the words of this extension change: its data need not be gone through again and again.
            alone = content_of([hdu])
            for word in [word for word in hdu.header if not OF_FITS.fullmatch(word) and word != "CONTHASH"]:
                before = hdu.header.copy()
                hdu.header[word] = other(hdu.header[word])
                assert (content_of([hdu]) == alone) == bool(APART.fullmatch(word)), (hdu.name, word)
                hdu.header.remove(word)
                assert (content_of([hdu]) == alone) == bool(APART.fullmatch(word)), (hdu.name, word)
                hdu.header = before
        assert content_of(hdus) == held


@pytest.mark.parametrize("word", ["DATE", "CREATOR", "SOFT1"])
def test_words_that_enter_no_number(path, word):
    before = read_calibration(path, any_model=True)
    copy = changed(path, lambda hdus: hdus[0].header.set(word, other(hdus[0].header[word])))
    back = read_calibration(copy, any_model=True)
    same_but = {"date": before.date, "versions": before.versions, "path": path}
    assert_same(contents(back) | same_but, contents(before), word)


def test_without_its_rule_a_product_is_not_fit_for_use(path):
    """Then it is one of an earlier rule."""
    product = read_calibration(changed(path, lambda hdus: hdus[0].header.remove("HASHRULE")), any_model=True)
    assert not all(check.passed for check in certify(product))


def test_words_that_may_be_missing(path, monkeypatch):
    """What the reader asks for in vain is put there: it is refused, or changes nothing."""
    before, there, asked = read_calibration(path, any_model=True), set(words(path)), set()
    with fits.open(path) as hdus:
        numbers = {hdu.name: n for n, hdu in enumerate(hdus)}
    for method in ("get", "__contains__", "__getitem__"):
        plain = getattr(fits.Header, method)

        def noted(header, key, *rest, plain=plain):
            if isinstance(key, str):
                name = next((card.value for card in header.cards if card.keyword == "EXTNAME"), "PRIMARY")
                asked.add((numbers[name], key))
            return plain(header, key, *rest)

        monkeypatch.setattr(fits.Header, method, noted)
    read_calibration(path, any_model=True)
    monkeypatch.undo()
    in_vain = {(n, word) for n, word in asked - there if word.isupper()}
    in_vain = {(n, word) for n, word in in_vain if not OF_FITS.fullmatch(word) and not APART.fullmatch(word)}
    assert {(numbers["HIDDEN"], "HIDE3"), (numbers["M21"], "ELEM2"), (numbers["M21"], "CROTA2")} <= in_vain
    for n, word in in_vain:
        copy = changed(path, lambda hdus, n=n, word=word: hdus[n].header.set(word, 2))
        if not refused(copy):
            back = contents(read_calibration(copy, any_model=True)) | {"path": path}
            assert_same(back, contents(before), f"{n} {word}")


def test_columns_and_images(path):
    count = 0
    with fits.open(path) as hdus:
        for hdu in hdus:
            for name in () if hdu.data is None else hdu.data.dtype.names or ("",):
                values, alone = hdu.data[name] if name else hdu.data, content_of([hdu])
                place = (0,) * values.ndim
                values[place] = other(values[place])
                assert (content_of([hdu]) == alone) == (name == "PATH"), (hdu.name, name)
                count += 1
    assert count > 50


def test_what_others_add_is_left_alone(path):
    """An archive adds words and extensions of its own."""

    def archived(hdus):
        hdus[0].header["ARCFILE"] = "ONE.2026-11-26.fits"
        hdus[0].header["HISTORY"] = "ingested"
        hdus.append(fits.ImageHDU(np.ones((2, 2)), name="PREVIEW"))

    before = read_calibration(path, any_model=True)
    back = read_calibration(changed(path, archived), any_model=True)
    assert_same(contents(back) | {"path": path}, contents(before), "product")
    assert back.content_hash() == before.content_hash() == fits.getval(path, "CONTHASH")


def test_a_product_of_an_earlier_rule_is_read_with_a_remark():
    product = read_calibration(EARLIER, any_model=True)
    assert product.names == ("pupil.magnification", "collimator.q", "throughput.n0.p00")
    assert product.values.tolist() == [15.63, 1.0 / 3.0, 0.5]
    assert UNCHECKED in product.verdict.warnings
    assert next(check.name for check in certify(product) if not check.passed) == "content"


def test_a_product_of_a_rule_to_come_is_refused(path):
    copy = changed(path, lambda hdus: hdus[0].header.set("HASHRULE", 3))
    with pytest.raises(DataError, match=r"HASHRULE: .*newer walop-jax"):
        read_calibration(copy, any_model=True)
