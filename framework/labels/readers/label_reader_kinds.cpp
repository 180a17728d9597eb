// The label files that `scene.labels.from` may name.
#include "labels/readers/label_readers.h"

namespace semfield {

const std::vector<StepKind<LabelReader>>& label_reader_kinds() {
  static const std::vector<StepKind<LabelReader>> kinds{
      {"labelme", "polygons, rectangles, circles and points of labelme: one JSON file per frame", &make_labelme_reader},
      {"coco", "polygons and run lengths of COCO: one JSON file for all frames", &make_coco_reader},
      {"images", "label images: class ids, palette indices, or exact colours", &make_image_label_reader},
      {"npz", "class probabilities of NumPy arrays: soft labels", &make_npz_reader},
      {"clicks",
       "single pixels or discs from a CSV file, or clicks and strokes of the labelling page; all else is void",
       &make_click_reader},
  };
  return kinds;
}

}  // namespace semfield
