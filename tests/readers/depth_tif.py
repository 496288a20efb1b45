"""depth.tif by tifffile (the container, tag by tag) and by GDAL (what a GIS makes of it)."""

import numpy as np
import rasterio
import tifffile
from rio_cogeo.cogeo import cog_validate
from expected import FOLDER, depth_mm, halved, map_geometry


def check_container(path, big):
    with tifffile.TiffFile(path) as tiff:
        assert tiff.is_bigtiff == big, "the container"
        assert tiff.is_geotiff, "no GeoTIFF"
        pages = list(tiff.pages)
        levels = tiff.series[0].levels
        assert len(levels) == len(pages) == 3, f"{len(levels)} levels, {len(pages)} pages"
        for page in pages:
            assert page.is_tiled and page.tile == (512, 512) and page.dtype == np.float32
            assert page.compression == tifffile.COMPRESSION.ADOBE_DEFLATE
            assert page.predictor == tifffile.PREDICTOR.FLOATINGPOINT
        np.testing.assert_array_equal(pages[0].asarray(), depth_mm())
        smaller = depth_mm()
        for page in pages[1:]:
            smaller = halved(smaller)
            np.testing.assert_allclose(page.asarray(), smaller, rtol=0, atol=2e-4)
        check_order(pages)
        keys = tiff.geotiff_metadata
        assert keys["GTRasterTypeGeoKey"] == 2, "pixels are points"
        assert keys["ProjLinearUnitsGeoKey"] == 1025, "millimetres"


def check_order(pages):
    """Cloud-optimised: directories, then the smallest overview, the full size last."""
    places = [page.offset for page in pages]
    assert places == sorted(places), "the directories' order"
    starts = [min(page.dataoffsets) for page in pages]
    ends = [max(o + n for o, n in zip(page.dataoffsets, page.databytecounts)) for page in pages]
    assert max(tag.valueoffset for page in pages for tag in page.tags) < min(starts), "tags behind tiles"
    for larger, smaller in zip(range(len(pages)), range(1, len(pages))):
        assert ends[smaller] <= starts[larger], "a large level before a small one"


def check_gdal(path):
    geometry = map_geometry()
    valid, errors, warnings = cog_validate(str(path), strict=True)
    assert valid and not errors and not warnings, (errors, warnings)
    with rasterio.open(path) as data:
        np.testing.assert_array_equal(data.read(1), depth_mm())
        assert np.isnan(data.nodata) and data.units == ("mm",) and data.dtypes == ("float32",)
        assert data.overviews(1) == [2, 4] and data.block_shapes == [(512, 512)]
        assert 'UNIT["millimetre",0.001' in data.crs.to_wkt(), data.crs.to_wkt()
        for column, row in [(0, 0), (1300, 0), (17, 610)]:
            # GDAL counts from a pixel's corner: its centre is at a half.
            x_mm, y_mm = data.transform * (column + 0.5, row + 0.5)
            assert abs(x_mm - (geometry["x0_mm"] + column * geometry["mm_per_px"])) < 1e-9, x_mm
            assert abs(y_mm - (geometry["y0_mm"] + row * geometry["mm_per_px"])) < 1e-9, y_mm
        # GDAL answers a small window from the overview that fits.
        reduced = data.read(1, out_shape=(306, 651))
        np.testing.assert_allclose(reduced, halved(depth_mm()), rtol=0, atol=2e-4)


for name, is_big in [("depth.tif", False), ("depth-big.tif", True)]:
    check_container(FOLDER / name, is_big)
    check_gdal(FOLDER / name)
