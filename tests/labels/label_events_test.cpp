// Label events: their text there and back, what is refused, and classes that are added, renamed, merged and deleted.
#include "core/error.h"
#include "labels/clicks/click_log.h"
#include "tests/labels/annotations_case.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

const std::string kClick =
    R"({"id":"a1-17","type":"click","frame":"rgb_12","size":[320,240],"points":[[12.5,33.0]],"radius":4,"class":"chair"})";

std::string refusal_of(const std::string& json) {
  return error_of([&] { (void)parse_label_event(json); });
}

// kClick with `from` replaced.
std::string click_with(const std::string& from, const std::string& to) {
  std::string text = kClick;
  return text.replace(text.find(from), from.size(), to);
}

TEST(LabelEvent, EveryKindIsReadAndWritten) {
  const LabelEvent click = parse_label_event(kClick);
  EXPECT_EQ(click.id, "a1-17");
  EXPECT_EQ(click.kind, LabelEventKind::click);
  EXPECT_EQ(click.unix_ms, 0);
  EXPECT_EQ(click.frame, "rgb_12");
  EXPECT_EQ(click.width_px, 320);
  EXPECT_EQ(click.height_px, 240);
  EXPECT_EQ(click.points, (std::vector<PixelPoint>{{12.5, 33}}));
  EXPECT_EQ(click.radius_px, 4);
  EXPECT_EQ(click.class_name, "chair");
  const LabelEvent made = parse_label_event(R"({"id":"b","type":"class","name":"chair","color":[200,30,0]})");
  EXPECT_EQ(made.kind, LabelEventKind::add_class);
  EXPECT_EQ(made.class_name, "chair");
  EXPECT_EQ(made.color, (std::array<std::uint8_t, 3>{200, 30, 0}));
  const LabelEvent renamed = parse_label_event(R"({"id":"c","type":"rename","class":"chair","name":"armchair"})");
  EXPECT_EQ(renamed.kind, LabelEventKind::change_class);
  EXPECT_EQ(renamed.class_name + ">" + renamed.new_name, "chair>armchair");
  EXPECT_FALSE(renamed.color.has_value());
  EXPECT_EQ(parse_label_event(R"({"id":"d","type":"undo","of":"a1-17"})").of, "a1-17");
  const LabelEvent skip = parse_label_event(R"({"id":"e","type":"skip","frame":"f","size":[4,3],"points":[[4,3]]})");
  EXPECT_EQ(skip.kind, LabelEventKind::skip);
  EXPECT_EQ(skip.points, (std::vector<PixelPoint>{{4, 3}}));
  const LabelEvent merged = parse_label_event(R"({"id":"f","type":"merge","class":"stool","into":"chair"})");
  EXPECT_EQ(merged.kind, LabelEventKind::merge_class);
  EXPECT_EQ(merged.class_name + ">" + merged.new_name, "stool>chair");
  const LabelEvent deleted = parse_label_event(R"({"id":"g","type":"delete","class":"stool"})");
  EXPECT_EQ(deleted.kind, LabelEventKind::delete_class);
  EXPECT_EQ(deleted.class_name, "stool");
  const LabelEvent outline =
      parse_label_event(click_with(R"([[12.5,33.0]],"radius":4)", R"([[1,1],[9,1],[9,5]],"radius":0,"fill":true)"));
  EXPECT_TRUE(outline.fill);
  EXPECT_FALSE(click.fill);
  const LabelEvent another = parse_label_event(click_with(R"("class":"chair")", R"("class":"chair","object":2)"));
  EXPECT_EQ(another.object, 2);
  EXPECT_EQ(click.object, 0);
  EXPECT_LACKS(label_event_json(click), "object");
  EXPECT_LACKS(label_event_json(click), "fill");  // an older program reads it, too

  for (LabelEvent event : {click, made, renamed, skip, merged, deleted, outline, another,
                           parse_label_event(R"({"id":"d","type":"undo","of":"q"})")}) {
    EXPECT_EQ(parse_label_event(label_event_json(event)), event) << label_event_json(event);
    event.unix_ms = 1790000000123;
    EXPECT_EQ(parse_label_event(label_event_json(event)), event) << label_event_json(event);
    EXPECT_EQ(label_event_json(event).find('\n'), std::string::npos);
  }
}

TEST(LabelEvent, EveryBitOfANumberAndOfANameComesBack) {
  LabelEvent event = parse_label_event(kClick);
  event.points = {{0, 0}, {0.1 + 0.2, 1.0 / 3}, {320, 240}, {5e-324, 239.99999999999997}};
  event.radius_px = 1e6 / 7;
  event.class_name = "Stuhl \"groß\" \\ 椅子";
  event.frame = "left/cam 1/0001";
  EXPECT_EQ(parse_label_event(label_event_json(event)), event);
  event.points.assign(kMostEventPoints, {123.45678901234567, 98.76543210987654});
  EXPECT_EQ(parse_label_event(label_event_json(event)), event);
}

TEST(LabelEvent, TheBoundsThemselvesAreTaken) {
  EXPECT_EQ(parse_label_event(click_with("[12.5,33.0]", "[320,240]")).points[0].x, 320);
  EXPECT_EQ(parse_label_event(click_with("[12.5,33.0]", "[0,0]")).points[0].x, 0);
  EXPECT_EQ(parse_label_event(click_with("[320,240]", "[65536,65536]")).width_px, 65536);
  EXPECT_EQ(parse_label_event(click_with("\"radius\":4", "\"radius\":1e6")).radius_px, 1e6);
  EXPECT_EQ(parse_label_event(click_with("\"radius\":4", "\"radius\":0")).radius_px, 0);
  EXPECT_EQ(parse_label_event(click_with("chair", std::string(128, 'c'))).class_name.size(), 128u);
  EXPECT_EQ(parse_label_event(click_with("a1-17", std::string(64, 'Z'))).id.size(), 64u);
}

TEST(LabelEvent, EveryRefusalNamesTheKey) {
  const std::pair<std::string, std::string> cases[] = {
      {"", "event: not valid JSON: parse error at line 1, column 1"},
      {"[]", "event: expected a map {\"id\":...,\"type\":...}, got a list of 0"},
      {"{}", "event: key 'type' is missing"},
      {R"({"type":"undo","of":"a"})", "event: key 'id' is missing"},
      {R"({"id":"a","type":"undo"})", "event: key 'of' is missing"},
      {R"({"id":"a","type":"undo","of":"a"})", "event: 'of': it is the event's own id"},
      {R"({"id":"a","type":"undo","of":7})",
       "event: 'of': expected 1 to 64 letters of a-z, A-Z, 0-9, '-' and '_', got 7"},
      {R"({"id":"a","type":"class"})", "event: key 'name' is missing"},
      {R"({"id":"a","type":"class","name":"b","color":[1,2]})",
       "event: 'color': expected [red, green, blue], got a list of 2"},
      {R"({"id":"a","type":"class","name":"b","color":[1,2,256]})",
       "event: 'color': expected whole numbers from 0 to 255, got 256"},
      {R"({"id":"a","type":"class","name":"b","color":[1,2,1.5]})",
       "event: 'color': expected whole numbers from 0 to 255, got 1.5"},
      {R"({"id":"a","type":"class","name":"b","colour":[1,2,3]})",
       "event: unknown key \"colour\" of a 'class'; did you mean 'color'?"},
      {R"({"id":"a","type":"rename","class":"b"})", "event: key 'name' is missing"},
      {R"({"id":"a","type":"skip","frame":"f","size":[4,3],"points":[[1,1],[2,2]]})",
       "event: 'points': expected a list of one point, got a list of 2"},
      {R"({"id":"a","type":"skip","frame":"f","size":[4,3],"points":[[1,1]],"radius":1})",
       "event: unknown key \"radius\" of a 'skip'"},
      {click_with("\"click\"", "\"klick\""),
       "event: 'type': expected click, class, rename, undo, skip, merge, delete, got \"klick\""},
      {R"({"id":"a","type":"merge","class":"b"})", "event: key 'into' is missing"},
      {R"({"id":"a","type":"merge","class":"b","into":7})",
       "event: 'into': expected a text of 1 to 128 bytes without control characters, got 7"},
      {R"({"id":"a","type":"delete"})", "event: key 'class' is missing"},
      {R"({"id":"a","type":"delete","class":"b","into":"c"})", "event: unknown key \"into\" of a 'delete'"},
      {click_with("\"class\":\"chair\"", "\"class\":\"chair\",\"fill\":1"),
       "event: 'fill': expected true or false, got 1"},
      {click_with("\"class\":\"chair\"", "\"class\":\"chair\",\"fill\":true"),
       "event: 'fill': an outline needs 3 points, and there are 1"},
      {click_with("a1-17", "a 17"),
       "event: 'id': expected 1 to 64 letters of a-z, A-Z, 0-9, '-' and '_', got \"a 17\""},
      {click_with("a1-17", ""), "event: 'id': expected 1 to 64 letters"},
      {click_with("a1-17", std::string(65, 'a')), "event: 'id': expected 1 to 64 letters"},
      {click_with("\"a1-17\"", "17"), "event: 'id': expected 1 to 64 letters"},
      {click_with("\"rgb_12\"", "12"),
       "event: 'frame': expected a text of 1 to 4096 bytes without control characters, got 12"},
      {click_with("rgb_12", "a\\nb"),
       "event: 'frame': expected a text of 1 to 4096 bytes without control characters, got \"a\\nb\""},
      {click_with("\"frame\":\"rgb_12\",", ""), "event: key 'frame' is missing"},
      {click_with("[320,240]", "[320]"), "event: 'size': expected [width, height], got a list of 1"},
      {click_with("[320,240]", "[0,240]"), "event: 'size': expected whole numbers from 1 to 65536, got 0"},
      {click_with("[320,240]", "[320,65537]"), "event: 'size': expected whole numbers from 1 to 65536, got 65537"},
      {click_with("[320,240]", "[320.5,240]"), "event: 'size': expected whole numbers from 1 to 65536, got 320.5"},
      {click_with("[320,240]", "[18446744073709551615,240]"),
       "event: 'size': expected whole numbers from 1 to 65536, got 18446744073709551615"},
      {click_with("[[12.5,33.0]]", "[]"), "event: 'points': expected a list of 1 to 4096 points, got a list of 0"},
      {click_with("[[12.5,33.0]]", "7"), "event: 'points': expected a list of 1 to 4096 points, got 7"},
      {click_with("[12.5,33.0]", "[12.5]"), "event: 'points': point 1 is not a pair of numbers [x, y]: a list of 1"},
      {click_with("[12.5,33.0]", "[1,2],[3,\"4\"]"), "event: 'points': point 2 is not a pair of numbers [x, y]"},
      {click_with("[12.5,33.0]", "[320.001,33]"),
       "event: 'points': point 1, (320.001, 33), lies outside the image of 320 x 240"},
      {click_with("[12.5,33.0]", "[1,-1e-300]"),
       "event: 'points': point 1, (1, -1e-300), lies outside the image of 320 x 240"},
      {click_with("[12.5,33.0]", "[1e999,1]"), "event: not valid JSON: number overflow"},
      {click_with("\"radius\":4", "\"radius\":-1"), "event: 'radius': expected pixels from 0 to a million, got -1"},
      {click_with("\"radius\":4", "\"radius\":1000001"),
       "event: 'radius': expected pixels from 0 to a million, got 1000001"},
      {click_with("\"radius\":4", "\"radius\":true"), "event: 'radius': expected pixels from 0 to a million, got true"},
      {click_with("\"radius\":4,", ""), "event: key 'radius' is missing"},
      {click_with("chair", ""),
       "event: 'class': expected a text of 1 to 128 bytes without control characters, got \"\""},
      {click_with("chair", std::string(129, 'c')), "event: 'class': expected a text of 1 to 128 bytes"},
      {click_with("chair", "ch\\u0000air"),
       "event: 'class': expected a text of 1 to 128 bytes without control characters"},
      {click_with("chair", "ch\xff"), "event: not valid JSON"},
      {click_with("\"id\":\"a1-17\"", "\"id\":\"b\",\"id\":\"a1-17\""), "event: key \"id\" is given twice"},
      {click_with("\"id\"", "\"time_ms\":-1,\"id\""), "event: 'time_ms': expected milliseconds since 1970, got -1"},
      {click_with("\"id\"", "\"klass\":1,\"id\""), "event: unknown key \"klass\" of a 'click'; did you mean 'class'?"},
      {kClick + "{}", "event: not valid JSON"},
      {std::string(kMostEventBytes + 1, ' '),
       "event: it is 262145 bytes long; at most 262144 are read; send a stroke in parts"},
  };
  for (const auto& [json, said] : cases)
    EXPECT_TRUE(refusal_of(json).find(said) == 0) << json << "\n" << refusal_of(json) << "\n" << said;
  std::string many;
  for (std::size_t i = 0; i <= kMostEventPoints; ++i) many += i == 0 ? "[1,1]" : ",[1,1]";
  EXPECT_EQ(refusal_of(click_with("[12.5,33.0]", many))
                .find("event: 'points': expected a list of 1 to 4096 points, got a list of 4097"),
            0u);
}

TEST(LabelEvent, DeepNestingIsRefusedWithoutACrash) {
  EXPECT_HAS(refusal_of(std::string(kMostEventBytes, '[')), "event: not valid JSON");
  const std::string deep = std::string(100000, '[') + std::string(100000, ']');
  EXPECT_NE(refusal_of(click_with("[12.5,33.0]", deep)), "");
}

// Classes merged and deleted with their clicks, filled outlines and regions to ignore; and every one of them undone.

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
            "event 'x': the place of the class 'stool' has been given to 'lamp'; add the class again, or undo 'lamp' "
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
