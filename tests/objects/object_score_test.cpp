// Panoptic quality by hand.
#include "objects/object_score.h"

#include <gtest/gtest.h>

namespace semfield {
namespace {

constexpr std::int16_t kWall = 0, kChair = 1, kTable = 2;
const std::vector<bool> kStuff{true, false, false};

struct Pixels {
  std::vector<std::int16_t> label, rendered;
  std::vector<std::int32_t> instance, object;
  void add(int count, std::int16_t true_class, std::int32_t true_object, std::int16_t class_index, std::int32_t found) {
    label.insert(label.end(), static_cast<std::size_t>(count), true_class);
    instance.insert(instance.end(), static_cast<std::size_t>(count), true_object);
    rendered.insert(rendered.end(), static_cast<std::size_t>(count), class_index);
    object.insert(object.end(), static_cast<std::size_t>(count), found);
  }
};

ObjectRow row(std::int32_t id, std::int16_t class_index) {
  ObjectRow out;
  out.id = id;
  out.class_index = class_index;
  return out;
}

TEST(ObjectScore, IsTheFormula) {
  // Two chairs, of which one is found with IoU 0.8 and the other not; a wrong table; all of the wall.
  const std::vector<ObjectRow> rows{row(1, kChair), row(2, kTable)};
  Pixels p;
  p.add(1000, kWall, 9, kWall, 0);
  p.add(80, kChair, 1, kChair, 1);
  p.add(20, kChair, 1, kChair, 0);
  p.add(50, kChair, 2, kTable, 2);
  ObjectScore score(rows, kStuff, 10);
  // In two halves: a segment is what a thing covers in all images.
  score.add({std::span(p.label).first(1040), std::span(p.instance).first(1040), std::span(p.rendered).first(1040),
             std::span(p.object).first(1040)});
  score.add({std::span(p.label).subspan(1040), std::span(p.instance).subspan(1040), std::span(p.rendered).subspan(1040),
             std::span(p.object).subspan(1040)});
  const ObjectFigures f = score.figures();
  // Wall 1; chairs 0.8 / (1 + 1/2); tables 0 / (1/2).
  EXPECT_NEAR(f.pq, (1 + 0.8 / 1.5 + 0) / 3, 1e-12);
  EXPECT_NEAR(f.sq, (1 + 0.8 + 0) / 3, 1e-12);
  EXPECT_NEAR(f.rq, (1 + 1 / 1.5 + 0) / 3, 1e-12);
  EXPECT_NEAR(f.pq_stuff, 1, 1e-12);
  EXPECT_NEAR(f.mcov, (0.8 + 1.0) / 2, 1e-12) << "whatever the class";
  EXPECT_NEAR(f.count_error, (1 + 1) / 2.0, 1e-12) << "a chair too few, a table too many";
  EXPECT_EQ(f.objects, 2);
  EXPECT_EQ(f.found, 2);
}

TEST(ObjectScore, VoidAndWhatIsTinyCountNowhere) {
  const std::vector<ObjectRow> rows{row(1, kChair), row(2, kChair), row(3, kTable)};
  Pixels p;
  p.add(100, kChair, 1, kChair, 1);
  p.add(100, kVoid, 0, kChair, 1);  // beside it, void: no part of the union
  p.add(30, kVoid, 0, kChair, 2);   // found in void alone
  p.add(9, kTable, 7, kTable, 3);   // too small to be true
  ObjectScore score(rows, kStuff, 10);
  score.add({p.label, p.instance, p.rendered, p.object});
  const ObjectFigures f = score.figures();
  EXPECT_NEAR(f.pq, 1, 1e-12);
  EXPECT_EQ(f.objects, 1);
  EXPECT_EQ(f.found, 1);
  EXPECT_EQ(f.count_error, 0);
}

TEST(ObjectScore, AnObjectOfAnotherClassDoesNotMatch) {
  Pixels p;
  p.add(100, kChair, 1, kTable, 1);
  const std::vector<ObjectRow> tables{row(1, kTable)}, unknown{row(1, kVoid)};
  ObjectScore wrong(tables, kStuff, 10), any(unknown, kStuff, 10);
  wrong.add({p.label, p.instance, p.rendered, p.object});
  any.add({p.label, p.instance, p.rendered, p.object});
  EXPECT_EQ(wrong.figures().pq, 0);
  EXPECT_EQ(any.figures().matched, 1) << "an object without a class matches any";
}

}  // namespace
}  // namespace semfield
