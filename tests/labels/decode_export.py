"""Reads exported labels back without the project's code: prints rows of class names' indices for the C++ test to compare.

usage: decode_export.py coco|labelme FILE IMAGE  -> width height, then one line of category names a pixel, row by row
"""
import json
import sys


def fill(points, width, height):
    """Pixels whose centre is inside by counting crossings to the right: a test for each pixel on its own."""
    edges = [(a, b) for a, b in zip(points, points[1:] + points[:1]) if a[1] != b[1]]
    inside = set()
    for y in range(height):
        cy = y + 0.5
        xs = sorted(a[0] + (cy - a[1]) * (b[0] - a[0]) / (b[1] - a[1])
                    for a, b in edges if min(a[1], b[1]) <= cy < max(a[1], b[1]))
        for x in range(width):
            if sum(1 for c in xs if c > x + 0.5) % 2 == 1:
                inside.add((x, y))
    return inside


def run_lengths(text):
    counts, at = [], 0
    while at < len(text):
        value, shift = 0, 0
        while True:
            digit = ord(text[at]) - 48
            at += 1
            value |= (digit & 31) << shift
            shift += 5
            if not digit & 32:
                break
        if digit & 16:
            value -= 1 << shift
        if len(counts) > 2:
            value += counts[-2]
        counts.append(value)
    return counts


def decode(segmentation, width, height):
    if isinstance(segmentation, list):
        pixels = set()
        for part in segmentation:
            pixels |= fill(list(zip(part[0::2], part[1::2])), width, height)
        return pixels
    assert segmentation["size"] == [height, width]
    pixels, at = set(), 0
    for number, count in enumerate(run_lengths(segmentation["counts"])):
        if number % 2 == 1:
            pixels |= {(i // height, i % height) for i in range(at, at + count)}
        at += count
    assert at == width * height
    return pixels


def main():
    kind, path, image_name = sys.argv[1:]
    with open(path) as file:
        root = json.load(file)
    masks = []
    if kind == "labelme":
        assert root["imagePath"].endswith(image_name), root["imagePath"]
        width, height = root["imageWidth"], root["imageHeight"]
        for shape in root["shapes"]:
            assert shape["shape_type"] == "polygon"
            masks.append((shape["label"], fill([tuple(p) for p in shape["points"]], width, height)))
    else:
        image = next(i for i in root["images"] if i["file_name"] == image_name)
        width, height = image["width"], image["height"]
        names = {c["id"]: "%d:%s" % (c["id"], c["name"]) for c in root["categories"]}
        ids = [a["id"] for a in root["annotations"]]
        assert len(set(ids)) == len(ids)
        for a in root["annotations"]:
            if a["image_id"] != image["id"]:
                continue
            pixels = decode(a["segmentation"], width, height)
            assert a["area"] == len(pixels), (a["area"], len(pixels))
            x, y, w, h = a["bbox"]
            assert (x, y) == (min(p[0] for p in pixels), min(p[1] for p in pixels))
            assert (x + w, y + h) == (max(p[0] for p in pixels) + 1, max(p[1] for p in pixels) + 1)
            masks.append((names[a["category_id"]], pixels))
    print(width, height)
    labels = {}
    for name, pixels in masks:
        assert not pixels & labels.keys(), "masks overlap"
        labels.update((p, name) for p in pixels)
    for y in range(height):
        for x in range(width):
            print(labels.get((x, y), "-"))


main()
