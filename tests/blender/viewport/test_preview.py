"""What training has made so far stands where it will stand when it is done."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from fruitlangs.operators.data.write_gaussians import REACH
from fruitlangs.operators.data.write_root import GROUND, find_focus, write_root
from fruitlangs.operators.drawing import splat_drawing
from fruitlangs.operators.steps import preview
from fruitlangs.operators.steps.preview import Preview


@pytest.fixture
def shown(extension, counted, monkeypatch, tmp_path):
    """Show the preview of a run on a source, as a tick of its job does; what was drawn, and where views were turned."""
    drawn, turned = [], []
    monkeypatch.setattr(preview, "SHOW_SECONDS", 0.0)
    monkeypatch.setattr(splat_drawing, "show_preview", lambda scene, interim: drawn.append(interim))
    monkeypatch.setattr(preview, "look_from_around", lambda screens, places, placed: turned.append(places))

    def shown(source):
        made = Preview(bpy.context.scene, source)
        for _ in range(2):
            made.watch(counted.gaussians, counted.scene)
            made.show(bpy.context)
        return drawn[-1], turned

    return shown


def test_without_an_import_it_stands_as_the_scene_that_is_trained_will(shown, counted, tmp_path):
    interim, turned = shown(tmp_path)
    assert len(turned) == 1  # at the first picture: the user may turn the view then
    assert len(interim.splats) == 20
    np.testing.assert_allclose(interim.centre, find_focus(counted.scene))
    assert interim.reach == pytest.approx(REACH * counted.scene.extent)
    np.testing.assert_allclose(interim.matrix, write_root(bpy.context.scene, counted.scene).matrix_basis, atol=1e-6)
    np.testing.assert_allclose(np.mean(turned[0], axis=0)[:2], (0.0, 0.0), atol=1e-5)


def test_what_is_shown_of_another_source_does_not_place_it(shown, counted, tmp_path):
    right = write_root(bpy.context.scene, counted.scene).matrix_basis.copy()
    write_root(bpy.context.scene, counted.scene).matrix_basis = Matrix.Translation((9.0, 9.0, 9.0))
    bpy.context.scene[GROUND] = [7.0, 7.0, 7.0]
    bpy.context.view_layer.update()
    (tmp_path / "one").mkdir()
    bpy.context.scene.fruitlangs.result.source = str(tmp_path / "one")
    np.testing.assert_allclose(shown(tmp_path / "two")[0].matrix, right, atol=1e-6)


def test_a_shown_scene_of_the_source_stays_where_the_user_put_it(shown, counted, tmp_path):
    write_root(bpy.context.scene, counted.scene).matrix_basis = Matrix.Translation((9.0, 9.0, 9.0))
    bpy.context.view_layer.update()
    bpy.context.scene.fruitlangs.result.source = str(tmp_path)
    interim, turned = shown(tmp_path)
    np.testing.assert_allclose(interim.matrix, Matrix.Translation((9.0, 9.0, 9.0)))
    assert turned == []
