// What tests of annotations share: events of two small frames, and what they add up to as text.
#pragma once

#include "labels/clicks/annotations.h"
#include "tests/labels/reader_case.h"

namespace semfield::testing_annotations {

using namespace testing_labels;

// Frames a (8 x 6), b (8 x 6) and t (test).
inline SceneInfo scene_of(const ClassTable& classes = {}) {
  SceneInfo scene{.frames = {frame_of("a", 8, 6), frame_of("b", 8, 6), frame_of("t", 8, 6)}};
  scene.frames[2].split = Split::test;
  scene.classes = classes;
  return scene;
}

inline LabelEvent click(const std::string& id, const std::string& name, PixelPoint at, double radius = 0,
                        const std::string& frame = "a") {
  return LabelEvent{
      .id = id, .frame = frame, .width_px = 8, .height_px = 6, .points = {at}, .radius_px = radius, .class_name = name};
}

inline LabelEvent add(const std::string& id, const std::string& name) {
  return LabelEvent{.id = id, .kind = LabelEventKind::add_class, .class_name = name};
}

inline LabelEvent rename(const std::string& id, const std::string& from, const std::string& to) {
  LabelEvent event = add(id, from);
  event.kind = LabelEventKind::change_class;
  event.new_name = to;
  return event;
}

inline LabelEvent undo(const std::string& id, const std::string& of) {
  return LabelEvent{.id = id, .kind = LabelEventKind::undo, .of = of};
}

inline std::string names_of_table(const ClassTable& table) {
  std::string out;
  for (const ClassEntry& e : table.entries()) out += std::to_string(e.id) + (e.ignore ? "-" : "=") + e.name + " ";
  return out;
}

inline Rows painted(const Annotations& annotations, int frame = 0, std::vector<std::int16_t> base = {}) {
  return rows_of({8, 6, annotations.paint(frame, base), {}});
}

inline std::string ids(const std::vector<Annotations::Mark>& marks) {
  std::string out;
  for (const Annotations::Mark& mark : marks) out += mark.id + " ";
  return out;
}

// Refused, and nothing has changed.
inline std::string refusal(Annotations& annotations, const LabelEvent& event) {
  const std::string classes = annotations.classes().to_yaml(), marks = ids(annotations.marks());
  const std::string checked = error_of([&] { (void)annotations.check(event); });
  const std::string applied = error_of([&] { (void)annotations.apply(event); });
  EXPECT_EQ(checked, applied);
  EXPECT_FALSE(annotations.seen(event.id)) << event.id;
  EXPECT_EQ(annotations.classes().to_yaml(), classes);
  EXPECT_EQ(ids(annotations.marks()), marks);
  return applied;
}

inline LabelEvent merge(const std::string& id, const std::string& from, const std::string& into) {
  LabelEvent event = rename(id, from, into);
  event.kind = LabelEventKind::merge_class;
  return event;
}

inline LabelEvent remove_class(const std::string& id, const std::string& name) {
  LabelEvent event = add(id, name);
  event.kind = LabelEventKind::delete_class;
  return event;
}

}  // namespace semfield::testing_annotations
