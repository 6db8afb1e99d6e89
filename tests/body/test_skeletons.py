from ntop.body import skeletons


def test_lists_agree_in_length_and_order():
    assert len(skeletons.SMPL24_NAMES) == len(set(skeletons.SMPL24_NAMES)) == 24
    assert len(skeletons.SMPL24_SIGMAS) == len(skeletons.SMPL24_PARTS) == 24
    assert len(skeletons.COCO17_NAMES) == len(skeletons.COCO17_SIGMAS) == 17
    assert len(skeletons.MEDIAPIPE33_NAMES) == 33
    assert len(skeletons.SMPL24_EDGES) == 23
    for joint, parent in enumerate(skeletons.SMPL24_PARENTS):
        assert parent < joint


def test_maps_between_skeletons_keep_names_and_sides():
    # MediaPipe's documented indices
    assert skeletons.MEDIAPIPE33_TO_COCO17 == (
        0, 2, 5, 7, 8, 11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28,
    )  # fmt: skip
    for name, part in zip(skeletons.COCO17_NAMES, skeletons.COCO17_PARTS, strict=True):
        expected = name if name in skeletons.SMPL24_NAMES else "head"
        assert skeletons.SMPL24_NAMES[part] == expected
    for start, end in skeletons.COCO17_SKELETON:
        names = skeletons.COCO17_NAMES[start], skeletons.COCO17_NAMES[end]
        crosses = names[0].startswith("left") and names[1].startswith("right")
        assert not crosses or names[0].split("_")[1] == names[1].split("_")[1], names


def test_shared_joints_share_sigmas():
    for name, sigma in zip(skeletons.COCO17_NAMES, skeletons.COCO17_SIGMAS, strict=True):
        if name in skeletons.SMPL24_NAMES:
            assert skeletons.SMPL24_SIGMAS[skeletons.SMPL24_NAMES.index(name)] == sigma
    sides = [n for n in skeletons.SMPL24_NAMES if n.startswith("left")]
    for name in sides:
        mirrored = skeletons.SMPL24_NAMES.index(name.replace("left", "right"))
        left = skeletons.SMPL24_NAMES.index(name)
        assert skeletons.SMPL24_SIGMAS[left] == skeletons.SMPL24_SIGMAS[mirrored]
