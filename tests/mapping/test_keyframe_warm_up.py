"""The kernels of the geometric side are there before a mapper is ready."""

from services.mapping.keyframes import context, retrieval, voxel_merge
from services.mapping.keyframes.warm_up import warm_up


def test_every_kernel_of_the_keyframes_is_compiled_by_the_warm_up():
    kernels = context._count_visible, voxel_merge._merge_voxels, retrieval._count_near

    warm_up()

    assert all(kernel.signatures for kernel in kernels)
