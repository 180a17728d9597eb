// Classes merged and deleted with their clicks, filled outlines and regions to ignore; and every one of them undone.
#include <gtest/gtest.h>

#include "tests/labels/annotations_case.h"

namespace semfield {
namespace {

using namespace testing_annotations;

// "id=class " of each mark.
std::string classes_of(const Annotations& annotations) {
  std::string out;
  for (const Annotations::Mark& mark : annotations.marks())
    out += mark.id + "=" + (mark.class_index == kVoid ? "ignore" : annotations.classes().valid(mark.class_index).name) +
           " ";
  return out;
}

// chair, stool and lamp with a click each: c, s, l.
Annotations three_classes() {
  Annotations annotations(scene_of(), 5);
  for (const char* name : {"chair", "stool", "lamp"}) annotations.apply(add(std::string("add_") + name, name));
  annotations.apply(click("c", "chair", {1, 1}));
  annotations.apply(click("s", "stool", {3, 3}));
  annotations.apply(click("l", "lamp", {5, 5}));
  return annotations;
}

TEST(ClassEvents, AMergedClassGivesItsClicksToTheOther) {
  Annotations annotations = three_classes();
  EXPECT_TRUE(annotations.apply(merge("m", "stool", "chair")));
  EXPECT_EQ(classes_of(annotations), "c=chair s=chair l=lamp ");
  EXPECT_EQ(names_of_table(annotations.named_table()), "0-void 1=chair 3=lamp ");
  EXPECT_EQ(painted(annotations)[3], "...0....");
  EXPECT_EQ(refusal(annotations, click("x", "stool", {1, 1})),
            "event 'x': no class 'stool' any more; it was merged into 'chair'");
  EXPECT_EQ(refusal(annotations, undo("x", "add_stool")),
            "event 'x': the class 'stool' was merged or deleted since; undo event 'm' first");
  EXPECT_EQ(refusal(annotations, undo("x", "add_chair")),
            "event 'x': the class 'chair' was merged or deleted since; undo event 'm' first");
  annotations.apply(undo("u", "m"));
  EXPECT_EQ(classes_of(annotations), "c=chair s=stool l=lamp ");
  annotations.apply(undo("v", "u"));
  EXPECT_EQ(classes_of(annotations), "c=chair s=chair l=lamp ");
  // A click that is undone and done again follows its class.
  annotations.apply(undo("w", "s"));
  EXPECT_EQ(classes_of(annotations), "c=chair l=lamp ");
  annotations.apply(undo("y", "w"));
  EXPECT_EQ(classes_of(annotations), "c=chair s=chair l=lamp ");
}

TEST(ClassEvents, ADeletedClassTakesItsClicksAndGivesThemBack) {
  Annotations annotations = three_classes();
  EXPECT_TRUE(annotations.apply(remove_class("d", "stool")));
  EXPECT_EQ(classes_of(annotations), "c=chair l=lamp ");
  EXPECT_FALSE(annotations.is_named(1));
  EXPECT_EQ(refusal(annotations, click("x", "stool", {1, 1})), "event 'x': no class 'stool' any more; it was deleted");
  annotations.apply(undo("u", "s"));  // takes nothing from the list, and counts when the class is back
  annotations.apply(click("s2", "lamp", {2, 2}));
  annotations.apply(undo("v", "d"));
  EXPECT_EQ(classes_of(annotations), "c=chair l=lamp s2=lamp ");
  annotations.apply(undo("w", "v"));
  EXPECT_EQ(refusal(annotations, undo("x", "u")),
            "event 'x': the class 'stool' of this click is deleted; bring the class back first");
  annotations.apply(undo("y", "w"));
  annotations.apply(undo("z", "u"));
  EXPECT_EQ(classes_of(annotations), "c=chair s=stool l=lamp s2=lamp ");
}

TEST(ClassEvents, MergesFollowEachOther) {
  Annotations annotations = three_classes();
  annotations.apply(merge("m1", "stool", "chair"));
  annotations.apply(merge("m2", "chair", "lamp"));
  EXPECT_EQ(classes_of(annotations), "c=lamp s=lamp l=lamp ");
  annotations.apply(remove_class("d", "lamp"));
  EXPECT_EQ(classes_of(annotations), "");
  EXPECT_EQ(refusal(annotations, remove_class("x", "lamp")), "event 'x': no class 'lamp' any more; it was deleted");
  annotations.apply(undo("u1", "m1"));  // the stool's clicks are its own again
  EXPECT_EQ(classes_of(annotations), "s=stool ");
  EXPECT_EQ(refusal(annotations, undo("x", "u1")),
            "event 'x': the class 'chair' is no longer there; bring the class back first");
  annotations.apply(undo("u2", "d"));
  EXPECT_EQ(classes_of(annotations), "c=lamp s=stool l=lamp ");
}

TEST(ClassEvents, ANameThatWasGivenAnewStaysWhereItIs) {
  Annotations annotations = three_classes();
  annotations.apply(remove_class("d", "stool"));
  annotations.apply(add("again", "stool"));
  annotations.apply(click("t", "stool", {7, 5}));
  EXPECT_EQ(classes_of(annotations), "c=chair l=lamp t=stool ");
  EXPECT_EQ(refusal(annotations, undo("x", "d")),
            "event 'x': there is a class 'stool' already; rename one of the two first");
  annotations.apply(rename("r", "stool", "bench"));
  annotations.apply(undo("u", "d"));
  EXPECT_EQ(classes_of(annotations), "c=chair s=stool l=lamp t=bench ");
}

TEST(ClassEvents, APlaceThatWasGivenAwayDoesNotComeBack) {
  Annotations annotations(scene_of(), 2);
  annotations.apply(add("1", "chair"));
  annotations.apply(add("2", "stool"));
  annotations.apply(click("3", "stool", {1, 1}));
  annotations.apply(merge("4", "stool", "chair"));
  annotations.apply(add("5", "lamp"));  // where the stool was
  annotations.apply(click("6", "lamp", {2, 2}));
  EXPECT_EQ(classes_of(annotations), "3=chair 6=lamp ");
  EXPECT_EQ(refusal(annotations, undo("x", "4")),
            "event 'x': the place of the class 'stool' has been given to 'lamp'; add the class anew, or undo 'lamp' "
            "first");
  annotations.apply(undo("7", "6"));
  annotations.apply(undo("8", "5"));
  annotations.apply(undo("9", "4"));
  EXPECT_EQ(classes_of(annotations), "3=stool ");
}

TEST(ClassEvents, WhatCannotBeMergedOrDeletedIsRefused) {
  Annotations annotations(scene_of(room_table()), 6);  // wall, chair, table are the scene's own
  annotations.apply(add("1", "stool"));
  EXPECT_EQ(refusal(annotations, merge("x", "wall", "stool")),
            "event 'x': the class 'wall' is one of the scene's own; merge the other one into it");
  EXPECT_EQ(refusal(annotations, remove_class("x", "wall")),
            "event 'x': the class 'wall' is one of the scene's own; undo its clicks instead");
  EXPECT_EQ(refusal(annotations, merge("x", "stool", "stool")),
            "event 'x': a class cannot be merged into itself; name another class");
  EXPECT_EQ(refusal(annotations, merge("x", "stool", "void")), "event 'x': 'void' stands for pixels without a class");
  EXPECT_EQ(refusal(annotations, remove_class("x", "void")), "event 'x': 'void' stands for pixels without a class");
  EXPECT_EQ(refusal(annotations, merge("x", "stol", "wall")), "event 'x': no class 'stol'; did you mean 'stool'?");
  EXPECT_EQ(refusal(annotations, merge("x", "stool", "wal")), "event 'x': no class 'wal'; did you mean 'wall'?");
  annotations.apply(click("2", "stool", {1, 1}));
  annotations.apply(merge("3", "stool", "wall"));
  EXPECT_EQ(classes_of(annotations), "2=wall ");
}

TEST(ClassEvents, AFilledOutlineIsItsInside) {
  Annotations annotations(scene_of(room_table()), 0);
  LabelEvent outline = click("1", "chair", {1, 1});
  outline.points = {{1, 1}, {6, 1}, {6, 4}, {1, 4}};
  outline.fill = true;
  annotations.apply(outline);
  EXPECT_EQ(painted(annotations), (Rows{"........", ".11111..", ".11111..", ".11111..", "........", "........"}));
  annotations.apply(undo("2", "1"));
  EXPECT_EQ(painted(annotations), (Rows(6, "........")));
  outline.id = "3";  // too thin to hold a pixel's centre: its line counts
  outline.points = {{1.1, 2.1}, {4.9, 2.1}, {4.9, 2.2}};
  annotations.apply(outline);
  EXPECT_EQ(painted(annotations)[2], ".1111...");
}

TEST(ClassEvents, WhatIsIgnoredHasNoLabelUntilItIsNamed) {
  Annotations annotations(scene_of(room_table()), 0);
  annotations.apply(click("1", "void", {3.5, 2.5}, 1.5));
  annotations.apply(click("2", "chair", {3.5, 2.5}));
  std::vector<std::int16_t> labels(48, 2);
  annotations.clear_ignored(0, 8, 6, labels);
  EXPECT_EQ(rows_of({8, 6, labels, {}}),
            (Rows{"22222222", "22...222", "22.2.222", "22...222", "22222222", "22222222"}));
  std::vector<std::int16_t> large(4 * 48, 2);  // an image of twice the size
  EXPECT_TRUE(annotations.clear_ignored(0, 16, 12, large));
  EXPECT_EQ(rows_of({16, 12, large, {}})[2], "22222....2222222");
  labels.assign(48, 2);
  annotations.clear_ignored(1, 8, 6, labels);
  EXPECT_EQ(labels, std::vector<std::int16_t>(48, 2));
}

}  // namespace
}  // namespace semfield
