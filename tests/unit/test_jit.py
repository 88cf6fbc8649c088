"""The key of the kernel cache: it must change with every source that a kernel is compiled from, and with no other."""

import pytest

from mavquad import jit

SOURCES = {
    "mavquad/__init__.py": "",
    "mavquad/quat.py": "from mavquad.jit import kernel\n@kernel\ndef product(p, q): return p\n",
    "mavquad/linalg.py": "import numpy as np\n",
    "mavquad/estimate/__init__.py": "",
    "mavquad/estimate/ekf.py": "from mavquad import linalg\nfrom mavquad.estimate.deep import (\n    step,\n    gains as g,\n)\n",
    "mavquad/estimate/deep.py": "def late():\n    import mavquad.quat\n",
    "sitl/plant.py": "from mavquad import quat as q, linalg\n",
}


@pytest.fixture
def tree(tmp_path, monkeypatch):
    monkeypatch.setattr(jit, "_ROOT", tmp_path)
    for name, text in SOURCES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def hashed(module: str) -> str:
        jit._source.cache_clear()
        jit._imports.cache_clear()
        return jit.source_hash([module])

    yield tmp_path, hashed
    jit._source.cache_clear()
    jit._imports.cache_clear()


@pytest.mark.parametrize(
    ("edited", "changed"),
    [
        ("mavquad/quat.py", {"mavquad.quat", "mavquad.estimate.ekf", "mavquad.estimate.deep", "sitl.plant"}),
        ("mavquad/linalg.py", {"mavquad.linalg", "mavquad.estimate.ekf", "sitl.plant"}),
        ("mavquad/estimate/deep.py", {"mavquad.estimate.ekf", "mavquad.estimate.deep"}),
        ("sitl/plant.py", {"sitl.plant"}),
    ],
)
def test_an_edit_changes_the_key_of_every_module_that_imports_it_however_indirectly(tree, edited, changed):
    root, hashed = tree
    modules = [name.removesuffix(".py").replace("/", ".") for name in SOURCES if not name.endswith("__init__.py")]
    before = {module: hashed(module) for module in modules}
    (root / edited).write_text(SOURCES[edited] + "# edited\n")
    assert {module for module in modules if hashed(module) != before[module]} == changed


def test_every_kernel_of_the_project_is_compiled_into_the_folder_of_its_own_sources():
    if not jit.COMPILED:
        pytest.skip("kernels run as plain Python")
    from mavquad import quat

    assert "mavquad.quat" in jit.kernel_modules()
    assert jit.source_hash(["mavquad.quat"]) in quat.mul._cache.cache_path
