"""The kinds of flexible objects. Each file has one kind: settings, geometry, refinement, clamps, `init` templates."""

from importlib import import_module
from pkgutil import iter_modules

from yid_ocp.model.objects.base import OBJECT_KINDS as OBJECT_KINDS
from yid_ocp.model.objects.base import ObjectBuilder as ObjectBuilder

# every file of this folder registers its kinds when it is imported
for _file in iter_modules(__path__):
    import_module(f"{__name__}.{_file.name}")
