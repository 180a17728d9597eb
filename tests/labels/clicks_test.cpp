// What tests of annotations share: events of two small frames, and what they add up to as text.

#include "labels/clicks.h"

#include <sys/resource.h>

#include <algorithm>
#include <csignal>

#include "core/error.h"
#include "core/files.h"
#include "labels/mask_outlines.h"
#include "labels/training_labels.h"
#include "tests/labels/reader_case.h"

namespace semfield {
namespace {

using namespace testing_labels;

// Frames a (8 x 6), b (8 x 6) and t (test).
SceneInfo scene_of(const ClassTable& classes = {}) {
  SceneInfo scene{.frames = {frame_of("a", 8, 6), frame_of("b", 8, 6), frame_of("t", 8, 6)}};
  scene.frames[2].split = Split::test;
  scene.classes = classes;
  return scene;
}

LabelEvent click(const std::string& id, const std::string& name, PixelPoint at, double radius = 0,
                 const std::string& frame = "a") {
  return LabelEvent{
      .id = id, .frame = frame, .width_px = 8, .height_px = 6, .points = {at}, .radius_px = radius, .class_name = name};
}

LabelEvent of_class(LabelEventKind kind, const std::string& id, const std::string& name, const std::string& to = "") {
  return LabelEvent{.id = id, .kind = kind, .class_name = name, .new_name = to};
}
LabelEvent add(const std::string& id, const std::string& name) { return of_class(LabelEventKind::add_class, id, name); }
LabelEvent rename(const std::string& id, const std::string& from, const std::string& to) {
  return of_class(LabelEventKind::change_class, id, from, to);
}
LabelEvent merge(const std::string& id, const std::string& from, const std::string& into) {
  return of_class(LabelEventKind::merge_class, id, from, into);
}
LabelEvent remove_class(const std::string& id, const std::string& name) {
  return of_class(LabelEventKind::delete_class, id, name);
}

LabelEvent undo(const std::string& id, const std::string& of) {
  return LabelEvent{.id = id, .kind = LabelEventKind::undo, .of = of};
}

std::string names_of_table(const ClassTable& table) {
  std::string out;
  for (const ClassEntry& e : table.entries()) out += std::to_string(e.id) + (e.ignore ? "-" : "=") + e.name + " ";
  return out;
}

Rows painted(const Annotations& annotations, int frame = 0, std::vector<std::int16_t> base = {}) {
  return rows_of({8, 6, annotations.paint(frame, base), {}});
}

std::string ids(const std::vector<Annotations::Mark>& marks) {
  std::string out;
  for (const Annotations::Mark& mark : marks) out += mark.id + " ";
  return out;
}

// All of them are taken.
void apply_all(Annotations& annotations, const std::vector<LabelEvent>& events) {
  for (const LabelEvent& event : events) EXPECT_TRUE(annotations.apply(event)) << event.id;
}

std::string ids_after(Annotations& annotations, const std::vector<LabelEvent>& events) {
  apply_all(annotations, events);
  return ids(annotations.marks());
}

// Refused, and nothing has changed.
std::string refusal(Annotations& annotations, const LabelEvent& event) {
  const std::string classes = annotations.classes().to_yaml(), marks = ids(annotations.marks());
  const std::string checked = error_of([&] { (void)annotations.check(event); });
  const std::string applied = error_of([&] { (void)annotations.apply(event); });
  EXPECT_EQ(checked, applied);
  EXPECT_FALSE(annotations.seen(event.id)) << event.id;
  EXPECT_EQ(annotations.classes().to_yaml(), classes);
  EXPECT_EQ(ids(annotations.marks()), marks);
  return applied;
}

// What label events add up to: classes that keep their places, clicks in order, undo and redo, and what they paint.

TEST(Annotations, ClassesGetTheNextFreeIdsBehindTheScenesOwn) {
  Annotations bare(scene_of(), 3);
  EXPECT_EQ(names_of_table(bare.classes()), "0-void 1=unnamed 1 2=unnamed 2 3=unnamed 3 ");
  EXPECT_EQ(bare.named_classes(), 0);
  EXPECT_TRUE(bare.apply(add("1", "chair")));
  EXPECT_EQ(names_of_table(bare.classes()), "0-void 1=chair 2=unnamed 2 3=unnamed 3 ");
  EXPECT_EQ(bare.classes().valid(0).color, ClassTable::default_color(1));
  EXPECT_EQ(names_of_table(bare.named_table()), "0-void 1=chair ");
  LabelEvent red = add("2", "lamp");
  red.color = {{200, 1, 2}};
  EXPECT_TRUE(bare.apply(red));
  EXPECT_EQ(bare.classes().valid(1).color, (std::array<std::uint8_t, 3>{200, 1, 2}));
  EXPECT_EQ(bare.named_classes(), 2);

  Annotations room(scene_of(room_table()), 5);  // wall 1, chair 4, table 7
  EXPECT_EQ(names_of_table(room.classes()), "0-void 1=wall 4=chair 7=table 8=unnamed 8 9=unnamed 9 ");
  EXPECT_EQ(room.named_classes(), 3);
  EXPECT_EQ(room.classes().valid(2).color, (std::array<std::uint8_t, 3>{70, 80, 90}));
  EXPECT_EQ(names_of_table(Annotations(scene_of(room_table()), 1).classes()), "0-void 1=wall 4=chair 7=table ");
  // A void class above does not push ids away, and is stepped over.
  const ClassTable high({{0, "wall", {}, false}, {2, "unlabeled", {}, true}, {255, "void", {}, true}});
  EXPECT_EQ(names_of_table(Annotations(scene_of(high), 3).classes()),
            "0=wall 1=unnamed 1 2-unlabeled 3=unnamed 3 255-void ");
  EXPECT_NE(error_of([] { Annotations many(scene_of(), 1025); }), "");
}

TEST(Annotations, AnEventCountsOnce) {
  Annotations annotations(scene_of(), 2);
  EXPECT_TRUE(annotations.check(add("1", "chair")));
  EXPECT_FALSE(annotations.seen("1"));
  EXPECT_TRUE(annotations.apply(add("1", "chair")));
  EXPECT_FALSE(annotations.apply(add("1", "table")));
  EXPECT_FALSE(annotations.check(add("1", "table")));
  EXPECT_EQ(annotations.named_classes(), 1);
  EXPECT_TRUE(annotations.apply(click("2", "chair", {1, 1})));
  EXPECT_FALSE(annotations.apply(click("2", "chair", {5, 5})));
  EXPECT_EQ(annotations.marks().size(), 1u);
}

TEST(Annotations, PaintsInOrderOverWhatWasThere) {
  Annotations annotations(scene_of(room_table()), 0);
  apply_all(annotations,
            {click("1", "chair", {3.5, 2.5}, 1.5), click("2", "table", {3.5, 2.5}), click("3", "wall", {8, 6})});
  EXPECT_EQ(painted(annotations), (Rows{"........", "..111...", "..121...", "..111...", "........", ".......0"}));
  EXPECT_EQ(painted(annotations, 1), (Rows(6, "........")));
  EXPECT_EQ(annotations.frames_with_marks(), std::vector<int>{0});
  apply_all(annotations, {click("4", "void", {3.5, 1.5}), click("5", "wall", {0, 0}, 0, "b")});
  EXPECT_EQ(annotations.marks()[3].class_index, kVoid);
  EXPECT_EQ(painted(annotations, 0, std::vector<std::int16_t>(48, 2)),
            (Rows{"22222222", "221.1222", "22121222", "22111222", "22222222", "22222220"}));
  EXPECT_EQ(annotations.frames_with_marks(), (std::vector<int>{0, 1}));
}

TEST(Annotations, PointsAreScaledToTheLoadedFrame) {
  Annotations annotations(scene_of(room_table()), 0);
  LabelEvent large = click("1", "chair", {14, 10}, 6);  // of an image four times as wide
  large.width_px = 32;
  large.height_px = 24;
  large.points.push_back({18, 10});
  annotations.apply(large);
  EXPECT_EQ(annotations.marks()[0].points, (std::vector<PixelPoint>{{3.5, 2.5}, {4.5, 2.5}}));
  EXPECT_EQ(annotations.marks()[0].radius_px, 1.5);
  EXPECT_EQ(painted(annotations), (Rows{"........", "..1111..", "..1111..", "..1111..", "........", "........"}));
  large.id = "2";
  large.height_px = 32;
  EXPECT_HAS(refusal(annotations, large), "event '2':", "32", "another shape");
}

TEST(Annotations, UndoAndItsUndoGiveTheSamePaintingInTheOldOrder) {
  Annotations annotations(scene_of(room_table()), 0);
  apply_all(annotations, {click("1", "chair", {3.5, 2.5}, 1.5), click("2", "table", {3.5, 2.5}, 1.5)});
  const Rows both = painted(annotations);
  EXPECT_EQ(ids_after(annotations, {undo("3", "1")}), "2 ");
  EXPECT_EQ(ids_after(annotations, {undo("4", "3")}), "1 2 ");
  EXPECT_EQ(painted(annotations), both);
  EXPECT_EQ(ids_after(annotations, {undo("5", "4")}), "2 ");
  annotations.apply(undo("6", "5"));
  EXPECT_EQ(painted(annotations), both);
  EXPECT_HAS(refusal(annotations, undo("7", "3")), "event '7':", "undone already");
  EXPECT_EQ(refusal(annotations, undo("7", "nobody")), "event '7': there is no event 'nobody' to undo");
  annotations.apply(undo("8", "2"));
  EXPECT_HAS(refusal(annotations, undo("9", "2")), "event '9':", "undone already");
}

TEST(Annotations, AClassThatClicksUseStaysUntilTheyAreUndone) {
  Annotations annotations(scene_of(), 3);
  apply_all(annotations, {add("1", "chair"), add("2", "lamp"), click("3", "chair", {1, 1})});
  EXPECT_EQ(refusal(annotations, undo("4", "1")), "event '4': the class 'chair' has 1 clicks; undo its clicks first");
  apply_all(annotations, {undo("5", "3"), undo("6", "1")});
  EXPECT_EQ(names_of_table(annotations.classes()), "0-void 1=unnamed 1 2=lamp 3=unnamed 3 ");
  EXPECT_EQ(annotations.named_classes(), 2);
  for (const int index : {-1, 0, 1, 2}) EXPECT_EQ(annotations.is_named(index), index == 1) << index;
  EXPECT_EQ(names_of_table(annotations.named_table()), "0-void 2=lamp ");
  EXPECT_HAS(refusal(annotations, undo("7", "5")), "event '7':", "chair", "is undone");
  EXPECT_HAS(refusal(annotations, click("7", "chair", {1, 1})), "event '7':", "chair", "no class");
  EXPECT_HAS(refusal(annotations, click("7", "unnamed 1", {1, 1})), "event '7':", "unnamed 1", "no class");
  annotations.apply(add("8", "table"));  // a place of its own
  EXPECT_EQ(names_of_table(annotations.classes()), "0-void 1=unnamed 1 2=lamp 3=table ");
  apply_all(annotations, {undo("9", "6"), undo("10", "5")});
  EXPECT_EQ(names_of_table(annotations.classes()), "0-void 1=chair 2=lamp 3=table ");
  EXPECT_EQ(ids(annotations.marks()), "3 ");
  EXPECT_HAS(refusal(annotations, add("11", "door")), "event '11':", "have names");
}

TEST(Annotations, AnUndoneClassGivesItsPlaceUpOnceEveryPlaceHasHadAName) {
  Annotations annotations(scene_of(), 2);
  std::vector<LabelEvent> events{
      add("1", "chair"), click("2", "chair", {1, 1}), undo("3", "2"), undo("4", "1"), rename("5", "lamp", "light"),
      add("6", "table"), click("7", "table", {2, 2})};
  events.insert(events.begin() + 4, add("4b", "lamp"));
  apply_all(annotations, events);
  EXPECT_EQ(names_of_table(annotations.classes()), "0-void 1=table 2=light ");
  EXPECT_EQ(annotations.marks().at(0).class_index, 0);
  EXPECT_FALSE(annotations.has_room());
  EXPECT_EQ(refusal(annotations, add("8", "door")).find("event '8': there is room for 2 classes"), 0u);
  // What was undone cannot come back as something else.
  EXPECT_HAS(refusal(annotations, undo("8", "4")), "event '8':", "chair", "table");
  EXPECT_HAS(refusal(annotations, undo("8", "3")), "event '8':", "chair", "is undone");
  // The file gives every class the same place again, and room of its own where there is more.
  EXPECT_EQ(names_of_table(replay(scene_of(), 2, events, "log").classes()), "0-void 1=table 2=light ");
  EXPECT_EQ(names_of_table(replay(scene_of(), 0, events, "log").named_table()), "0-void 2=light 3=table ");
  apply_all(annotations, {undo("8", "7"), undo("9", "6"), undo("10", "4")});
  EXPECT_EQ(names_of_table(annotations.classes()), "0-void 1=chair 2=light ");
  EXPECT_EQ(ids_after(annotations, {undo("11", "3")}), "2 ");
}

TEST(Annotations, ARenamingStaysWithItsClassWhenThePlaceIsGivenAway) {
  Annotations annotations(scene_of(), 1);
  apply_all(annotations, {add("1", "chair"), undo("2", "1"), add("3", "table"), rename("4", "table", "desk"),
                          undo("5", "3"), undo("6", "2")});
  EXPECT_EQ(names_of_table(annotations.classes()), "0-void 1=chair ");
}

TEST(Annotations, ARenamedClassKeepsItsPlaceAndItsClicks) {
  Annotations annotations(scene_of(room_table()), 6);
  apply_all(annotations, {add("1", "armchair"), click("2", "armchair", {1, 1})});
  LabelEvent stool = rename("3", "armchair", "stool");
  stool.color = {{9, 8, 7}};
  annotations.apply(stool);
  EXPECT_EQ(annotations.classes().valid(3).name, "stool");
  EXPECT_EQ(annotations.classes().valid(3).color, (std::array<std::uint8_t, 3>{9, 8, 7}));
  EXPECT_EQ(annotations.marks()[0].class_index, 3);
  annotations.apply(click("4", "stool", {2, 2}));
  EXPECT_EQ(refusal(annotations, click("5", "armchair", {2, 2})).find("event '5': no class 'armchair'"), 0u);
  annotations.apply(add("6", "armchair"));  // the name is free again
  EXPECT_HAS(refusal(annotations, undo("7", "3")), "event '7':", "armchair", "already");
  apply_all(annotations, {undo("8", "6"), undo("9", "3")});
  EXPECT_EQ(annotations.classes().valid(3).name, "armchair");
  EXPECT_EQ(annotations.classes().valid(3).color, ClassTable::default_color(8));
  EXPECT_EQ(annotations.marks()[1].class_index, 3);
  EXPECT_HAS(refusal(annotations, undo("10", "8")), "event '10':", "armchair", "already");
  // The scene's own classes keep their names, which its files use; colours are free.
  EXPECT_HAS(refusal(annotations, rename("11", "chair", "sofa")), "event '11':", "chair", "the class");
  LabelEvent color = rename("12", "chair", "chair");
  color.color = {{1, 2, 3}};
  annotations.apply(color);
  EXPECT_EQ(annotations.classes().valid(1).color, (std::array<std::uint8_t, 3>{1, 2, 3}));
  EXPECT_EQ(annotations.classes().valid(1).name, "chair");
}

TEST(Annotations, SkipsAreListedAndUndone) {
  Annotations annotations(scene_of(room_table()), 0);
  LabelEvent skip = click("1", "", {2, 3});
  skip.kind = LabelEventKind::skip;
  annotations.apply(skip);
  EXPECT_EQ(ids(annotations.skips()), "1 ");
  EXPECT_TRUE(annotations.marks().empty());
  EXPECT_TRUE(annotations.frames_with_marks().empty());
  annotations.apply(undo("2", "1"));
  EXPECT_TRUE(annotations.skips().empty());
}

// Label events there and back. What is refused of them: tests/bad_files/labels.cases.

const std::string kClick =
    R"({"id":"a1-17","type":"click","frame":"rgb_12","size":[320,240],"points":[[12.5,33.0]],"radius":4,"class":"chair"})";

// kClick with `from` replaced.
std::string click_with(const std::string& from, const std::string& to) {
  std::string text = kClick;
  return text.replace(text.find(from), from.size(), to);
}

TEST(LabelEvent, EveryKindIsReadAndWritten) {
  using K = LabelEventKind;
  LabelEvent click = semfield::click("a1-17", "chair", {12.5, 33}, 4, "rgb_12");
  click.width_px = 320;
  click.height_px = 240;
  LabelEvent outline = click, another = click;
  outline.points = {{1, 1}, {9, 1}, {9, 5}};
  outline.radius_px = 0;
  outline.fill = true;
  another.object = 2;
  const LabelEvent skip{.id = "e", .kind = K::skip, .frame = "f", .width_px = 4, .height_px = 3, .points = {{4, 3}}};
  LabelEvent red = add("b", "chair");
  red.color = {{200, 30, 0}};
  const std::pair<std::string, LabelEvent> kinds[] = {
      {kClick, click},
      {click_with(R"([[12.5,33.0]],"radius":4)", R"([[1,1],[9,1],[9,5]],"radius":0,"fill":true)"), outline},
      {click_with(R"("class":"chair")", R"("class":"chair","object":2)"), another},
      {R"({"id":"b","type":"class","name":"chair","color":[200,30,0]})", red},
      {R"({"id":"c","type":"rename","class":"chair","name":"armchair"})", rename("c", "chair", "armchair")},
      {R"({"id":"d","type":"undo","of":"a1-17"})", undo("d", "a1-17")},
      {R"({"id":"e","type":"skip","frame":"f","size":[4,3],"points":[[4,3]]})", skip},
      {R"({"id":"f","type":"merge","class":"stool","into":"chair"})", merge("f", "stool", "chair")},
      {R"({"id":"g","type":"delete","class":"stool"})", remove_class("g", "stool")}};
  for (auto [json, event] : kinds) {
    EXPECT_EQ(parse_label_event(json), event) << json;
    for (const std::int64_t ms : {std::int64_t{0}, std::int64_t{1790000000123}}) {
      event.unix_ms = ms;
      EXPECT_EQ(parse_label_event(label_event_json(event)), event) << label_event_json(event);
      EXPECT_EQ(label_event_json(event).find('\n'), std::string::npos);
    }
  }
  EXPECT_LACKS(label_event_json(click), "object", "fill");  // an older program reads it, too
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

// Classes merged and deleted with their clicks, filled outlines and regions to ignore; and every one of them undone.

// "id=class " of each mark.
std::string classes_of(const Annotations& annotations) {
  std::string out;
  for (const Annotations::Mark& mark : annotations.marks())
    out += mark.id + "=" + (mark.class_index == kVoid ? "ignore" : annotations.classes().valid(mark.class_index).name) +
           " ";
  return out;
}

std::string classes_after(Annotations& annotations, const std::vector<LabelEvent>& events) {
  apply_all(annotations, events);
  return classes_of(annotations);
}

// chair, stool and lamp with a click each: c, s, l.
Annotations three_classes() {
  Annotations annotations(scene_of(), 5);
  for (const char* name : {"chair", "stool", "lamp"}) annotations.apply(add(std::string("add_") + name, name));
  apply_all(annotations, {click("c", "chair", {1, 1}), click("s", "stool", {3, 3}), click("l", "lamp", {5, 5})});
  return annotations;
}

TEST(ClassEvents, AMergedClassGivesItsClicksToTheOther) {
  Annotations annotations = three_classes();
  EXPECT_EQ(classes_after(annotations, {merge("m", "stool", "chair")}), "c=chair s=chair l=lamp ");
  EXPECT_EQ(names_of_table(annotations.named_table()), "0-void 1=chair 3=lamp ");
  EXPECT_EQ(painted(annotations)[3], "...0....");
  EXPECT_HAS(refusal(annotations, click("x", "stool", {1, 1})), "event 'x':", "stool", "chair");
  EXPECT_HAS(refusal(annotations, undo("x", "add_stool")), "event 'x':", "stool", "deleted since");
  EXPECT_HAS(refusal(annotations, undo("x", "add_chair")), "event 'x':", "chair", "deleted since");
  EXPECT_EQ(classes_after(annotations, {undo("u", "m")}), "c=chair s=stool l=lamp ");
  EXPECT_EQ(classes_after(annotations, {undo("v", "u")}), "c=chair s=chair l=lamp ");
  // A click that is undone and done again follows its class.
  EXPECT_EQ(classes_after(annotations, {undo("w", "s")}), "c=chair l=lamp ");
  EXPECT_EQ(classes_after(annotations, {undo("y", "w")}), "c=chair s=chair l=lamp ");
}

TEST(ClassEvents, ADeletedClassTakesItsClicksAndGivesThemBack) {
  Annotations annotations = three_classes();
  EXPECT_EQ(classes_after(annotations, {remove_class("d", "stool")}), "c=chair l=lamp ");
  EXPECT_FALSE(annotations.is_named(1));
  EXPECT_EQ(refusal(annotations, click("x", "stool", {1, 1})), "event 'x': no class 'stool' any more; it was deleted");
  annotations.apply(undo("u", "s"));  // takes nothing from the list, and counts when the class is back
  EXPECT_EQ(classes_after(annotations, {click("s2", "lamp", {2, 2}), undo("v", "d")}), "c=chair l=lamp s2=lamp ");
  annotations.apply(undo("w", "v"));
  EXPECT_HAS(refusal(annotations, undo("x", "u")), "event 'x':", "stool", "is deleted");
  EXPECT_EQ(classes_after(annotations, {undo("y", "w"), undo("z", "u")}), "c=chair s=stool l=lamp s2=lamp ");
}

TEST(ClassEvents, MergesFollowEachOther) {
  Annotations annotations = three_classes();
  EXPECT_EQ(classes_after(annotations, {merge("m1", "stool", "chair"), merge("m2", "chair", "lamp")}),
            "c=lamp s=lamp l=lamp ");
  EXPECT_EQ(classes_after(annotations, {remove_class("d", "lamp")}), "");
  EXPECT_EQ(refusal(annotations, remove_class("x", "lamp")), "event 'x': no class 'lamp' any more; it was deleted");
  EXPECT_EQ(classes_after(annotations, {undo("u1", "m1")}), "s=stool ") << "the stool's clicks are its own again";
  EXPECT_HAS(refusal(annotations, undo("x", "u1")), "event 'x':", "chair", "longer there");
  EXPECT_EQ(classes_after(annotations, {undo("u2", "d")}), "c=lamp s=stool l=lamp ");
}

TEST(ClassEvents, ANameThatWasGivenAnewStaysWhereItIs) {
  Annotations annotations = three_classes();
  EXPECT_EQ(
      classes_after(annotations, {remove_class("d", "stool"), add("again", "stool"), click("t", "stool", {7, 5})}),
      "c=chair l=lamp t=stool ");
  EXPECT_HAS(refusal(annotations, undo("x", "d")), "event 'x':", "stool", "already");
  EXPECT_EQ(classes_after(annotations, {rename("r", "stool", "bench"), undo("u", "d")}),
            "c=chair s=stool l=lamp t=bench ");
}

TEST(ClassEvents, APlaceThatWasGivenAwayDoesNotComeBack) {
  Annotations annotations(scene_of(), 2);
  apply_all(annotations,
            {add("1", "chair"), add("2", "stool"), click("3", "stool", {1, 1}), merge("4", "stool", "chair")});
  EXPECT_EQ(classes_after(annotations, {add("5", "lamp"), click("6", "lamp", {2, 2})}), "3=chair 6=lamp ")
      << "where the stool was";
  EXPECT_HAS(refusal(annotations, undo("x", "4")), "event 'x':", "stool", "lamp");
  EXPECT_EQ(classes_after(annotations, {undo("7", "6"), undo("8", "5"), undo("9", "4")}), "3=stool ");
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
  apply_all(annotations, {click("1", "void", {3.5, 2.5}, 1.5), click("2", "chair", {3.5, 2.5})});
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

// A run's file of clicks: which it is and whose, whether it is the one that training knew, how it is written and read.

using testing_room::fresh_folder;

std::string log_of(const std::vector<LabelEvent>& events) {
  std::string text;
  for (const LabelEvent& event : events) text += label_event_json(event) + "\n";
  return text;
}

EventsKnown known_of(const std::vector<LabelEvent>& events) {
  EventsKnown known;
  for (const LabelEvent& event : events) known.add(event);
  return known;
}

struct RunOfClicks {
  std::string dir;
  LabelConfig labels;
  explicit RunOfClicks(const std::string& name, int room = 4) : dir(fresh_folder(name)) {
    labels.selection.clicks = dir + "/clicks.jsonl";
    labels.selection.class_room = room;
    settle_click_file(labels, dir);
    write_file_atomic(dir + "/run.yaml", "name: " + name + "\n");
  }
  std::string refusal(const ClicksTrained& trained) const {
    Diagnostics ignored;
    return error_of([&] { require_clicks(trained, labels, dir, ignored); });
  }
  std::string warning(const ClicksTrained& trained) const {
    Diagnostics found;
    require_clicks(trained, labels, dir, found);
    return found.all().empty() ? "" : found.all().front().text();
  }
};

const std::vector<LabelEvent> kThree{add("1", "chair"), add("2", "table"), add("3", "lamp")};

TEST(ClickFile, ARunsOwnIsWrittenAsSuchAndAnotherByItsPlace) {
  RunOfClicks run("click_file_own");
  EXPECT_EQ(run.labels.selection.clicks, "clicks.jsonl");
  EXPECT_EQ(run.labels.click_file(), run.dir + "/clicks.jsonl");
  // Trained anew in another folder: that run's clicks are still those of the first.
  LabelConfig anew{.selection = {.clicks = "clicks.jsonl"}, .run_dir = run.dir};
  settle_click_file(anew, run.dir + "/anew");
  EXPECT_EQ(anew.selection.clicks, run.dir + "/clicks.jsonl");
  LabelConfig none;
  settle_click_file(none, run.dir);
  EXPECT_EQ(none.selection.clicks, "");
  EXPECT_EQ(none.click_file(), "");
}

TEST(ClickFile, ClicksThatTrainingKnewHaveToBeThere) {
  const RunOfClicks run("click_file_lost");
  const std::string file = run.dir + "/clicks.jsonl",
                    remedy = "; put the file back, or say where it is: --set scene.labels.clicks=FILE";
  const ClicksTrained trained{true, known_of(kThree)}, nothing{true, EventsKnown{}}, earlier{true, std::nullopt}, begun;
  EXPECT_HAS(run.refusal(trained), run.dir, file);
  EXPECT_EQ(run.refusal(nothing), "");
  EXPECT_EQ(run.refusal(begun), "");
  EXPECT_HAS(run.refusal(earlier), file, run.dir);
  write_file_atomic(file, "");
  EXPECT_HAS(run.refusal(trained), run.dir, file);
  EXPECT_EQ(run.refusal(earlier), "");
  write_file_atomic(file, log_of(kThree));
  EXPECT_EQ(run.warning(trained), "");
  std::vector<LabelEvent> more = kThree;
  more.push_back(add("4", "door"));
  write_file_atomic(file, log_of(more));
  EXPECT_EQ(run.warning(trained), "") << "clicks that come later are no change";
  write_file_atomic(file, log_of({kThree[0], kThree[2], kThree[1]}));
  EXPECT_HAS(run.warning(trained), file, "other clicks");
  RunOfClicks without("click_file_no_room", 0);
  EXPECT_HAS(without.refusal(begun), without.dir + "/clicks.jsonl", without.dir);
}

TEST(ClickFile, NobodyAppendsToAnotherRunsClicks) {
  const RunOfClicks first("click_file_first");
  write_file_atomic(first.dir + "/clicks.jsonl", log_of(kThree));
  LabelConfig labels{.selection = {.clicks = first.dir + "/clicks.jsonl"}};
  Diagnostics diagnostics;
  EXPECT_EQ(error_of([&] { (void)open_click_log(labels, fresh_folder("click_file_second"), diagnostics); })
                .find("the clicks in '" + first.dir +
                      "/clicks.jsonl' are those of another run, so none are added to them; continue that run"),
            0u);
  EXPECT_EQ(read_text_file(first.dir + "/clicks.jsonl"), log_of(kThree));
  ClickLog own = open_click_log(first.labels, first.dir, diagnostics);
  EXPECT_EQ(own.events().size(), 3u);
}

TEST(ClickFile, AFileThatHasGrownSinceItWasReadIsRefused) {
  RunOfClicks run("click_file_grown");
  SceneInfo scene;
  run.labels.clicks.emplace(replay(scene, 4, kThree, "log"));
  write_file_atomic(run.dir + "/clicks.jsonl", log_of({kThree[0]}));
  Diagnostics diagnostics;
  EXPECT_HAS(error_of([&] { (void)open_click_log(run.labels, run.dir, diagnostics); }), run.dir + "/clicks.jsonl",
             "was opened");
  write_file_atomic(run.dir + "/clicks.jsonl", log_of(kThree));
  EXPECT_EQ(open_click_log(run.labels, run.dir, diagnostics).events().size(), 3u);
}

// The file of label events: what is appended stays, torn lines are cut, other bad lines are named.

std::string line(const std::string& id) { return label_event_json(undo(id, "x")) + "\n"; }

std::string event_ids(const std::vector<LabelEvent>& events) {
  std::string out;
  for (const LabelEvent& event : events) out += event.id + " ";
  return out;
}

// The log of a folder of its own, with one event.
struct ClickLogOfOne : testing::Test {
  const std::string folder = fresh_folder("click_log_test"), path = folder + "/clicks.jsonl";
  Diagnostics diagnostics;
  ClickLog log = ClickLog::open(path, diagnostics);
  ClickLogOfOne() {
    EXPECT_TRUE(fs::exists(path) && log.events().empty());
    log.append(undo("1", "x"));
  }
};

TEST_F(ClickLogOfOne, KeepsWhatIsAppended) {
  EXPECT_EQ(read_text_file(path), line("1"));
  {
    ClickLog moved = std::move(log);
    moved.append(undo("2", "x"));
    EXPECT_EQ(event_ids(moved.events()), "1 2 ");
  }
  ClickLog again = ClickLog::open(path, diagnostics);
  again.append(undo("3", "2"));
  EXPECT_EQ(event_ids(again.events()), "1 2 3 ");
  EXPECT_EQ(read_click_log(path, diagnostics), again.events());
  EXPECT_EQ(all_said(diagnostics), "");
}

TEST(ClickLog, CutsATornLineAndSaysSo) {
  const std::string path = fresh_folder("click_log_test") + "/clicks.jsonl";
  const std::string whole = line("1") + line("2"), said = ":3: the last line is incomplete";
  for (const std::string& torn : {line("3").substr(0, 1), line("3").substr(0, line("3").size() - 1),
                                  std::string(5, '\0'), line("3").substr(0, 9) + std::string(7, '\0') + "\"}\n"}) {
    testing_room::plain_write(path, whole + torn);
    Diagnostics read, opened;
    EXPECT_EQ(event_ids(read_click_log(path, read)), "1 2 ");
    EXPECT_HAS(all_said(read), path + said);
    EXPECT_EQ(read_text_file(path), whole + torn);  // reading changes nothing
    ClickLog log = ClickLog::open(path, opened);
    EXPECT_EQ(all_said(opened), all_said(read));
    EXPECT_EQ(read_text_file(path), whole);
    log.append(undo("4", "x"));
    EXPECT_EQ(read_text_file(path), whole + line("4"));
  }
}

// What else is wrong with lines: tests/bad_files/labels.cases.
TEST(ClickLog, ABadLineInTheMiddleChangesNothing) {
  const std::string path = fresh_folder("click_log_test") + "/clicks.jsonl",
                    text = line("1") + "nonsense\n" + line("3");
  testing_room::plain_write(path, text);
  Diagnostics diagnostics;
  const std::string error = error_of([&] { (void)read_click_log(path, diagnostics); });
  EXPECT_HAS(error, path + ":2: event: not valid JSON");
  EXPECT_EQ(error_of([&] { (void)ClickLog::open(path, diagnostics); }), error);
  EXPECT_EQ(read_text_file(path), text);
}

TEST_F(ClickLogOfOne, AFailedAppendLeavesTheFileAndALaterOneSucceeds) {
  rlimit before{};
  ASSERT_EQ(getrlimit(RLIMIT_FSIZE, &before), 0);
  const auto handler = std::signal(SIGXFSZ, SIG_IGN);
  const rlimit tight{line("1").size() + 10, before.rlim_max};  // ten bytes of the next line fit
  ASSERT_EQ(setrlimit(RLIMIT_FSIZE, &tight), 0);
  const std::string error = error_of([&] { log.append(undo("2", "x")); });
  ASSERT_EQ(setrlimit(RLIMIT_FSIZE, &before), 0);
  (void)std::signal(SIGXFSZ, handler);
  EXPECT_EQ(error.find("cannot append to '" + path + "': the limit of a file's size is reached: need "), 0u) << error;
  EXPECT_EQ(event_ids(log.events()), "1 ");
  EXPECT_EQ(read_text_file(path), line("1"));
  log.append(undo("3", "x"));
  EXPECT_EQ(read_text_file(path), line("1") + line("3"));
  EXPECT_EQ(event_ids(log.events()), "1 3 ");
}

TEST_F(ClickLogOfOne, ASecondWriterIsRefusedAndTold) {
  fs::create_symlink(path, folder + "/link.jsonl");
  for (const std::string& name : {path, folder + "/link.jsonl", folder + "/./clicks.jsonl"}) {
    const std::string error = error_of([&] { (void)ClickLog::open(name, diagnostics); });
    EXPECT_EQ(error.find("the file of clicks '" + name + "' is in use by process " + std::to_string(getpid()) + " on "),
              0u)
        << error;
  }
  EXPECT_EQ(event_ids(read_click_log(path, diagnostics)), "1 ");  // reading takes no hold
  { const ClickLog ended = std::move(log); }
  ClickLog again = ClickLog::open(path, diagnostics);
  EXPECT_EQ(event_ids(again.events()), "1 ");
}

// A program that takes no lock: its lines stay, and nothing is appended behind them or cut off with them.
TEST_F(ClickLogOfOne, WhatAnotherProgramWroteIsNeitherCutOffNorBuiltUpon) {
  for (const std::string& theirs : {line("1") + line("2"), line("1").substr(4), std::string()}) {
    testing_room::plain_write(path, theirs);
    const std::string error = error_of([&] { log.append(undo("3", "x")); });
    EXPECT_EQ(error, "'" + path + "' has " + std::to_string(theirs.size()) + " bytes where this program left " +
                         std::to_string(line("1").size()) +
                         ": another program has changed it; end that program, and start this one again");
    EXPECT_EQ(read_text_file(path), theirs);
    EXPECT_EQ(event_ids(log.events()), "1 ");
  }
  fs::remove(path);
  EXPECT_HAS(error_of([&] { log.append(undo("3", "x")); }), path, "to it");
  EXPECT_FALSE(fs::exists(path));
}

// `scene.labels.from: {type: clicks}` of a log of label events, and scene.labels.clicks and .class_room over labels.

const std::string kLog = R"({"id":"1","type":"class","name":"lamp","color":[1,2,3]}
{"id":"2","type":"click","frame":"a","size":[8,6],"points":[[1,1]],"radius":0,"class":"lamp"}
{"id":"3","type":"click","frame":"a","size":[4,3],"points":[[2.5,1.5]],"radius":1,"class":"lamp"}
{"id":"4","type":"rename","class":"lamp","name":"light"}
{"id":"5","type":"click","frame":"b","size":[4,3],"points":[[0,0]],"radius":0,"class":"light"}
{"id":"6","type":"undo","of":"5"}
)";

std::string log_file(const std::string& text, const std::string& name = "clicks.jsonl") {
  const std::string path = fresh_folder("click_reader") + "/" + name;
  testing_room::plain_write(path, text);
  return path;
}

TEST(ClickReader, ReadsALogOfTheLabellingPage) {
  for (const char* name : {"clicks.jsonl", "other.txt"}) {  // by its extension, or by what is in it
    const auto reader = make_reader("clicks", "file: " + log_file(kLog, name));
    Diagnostics diagnostics;
    const ClassTable table = open_for(*reader, {}, {frame_of("a"), frame_of("b")}, diagnostics);
    EXPECT_TRUE(diagnostics.all().empty());
    EXPECT_TRUE(reader->adds_classes());
    EXPECT_EQ(names_of_table(table), "0-void 1=light ");
    EXPECT_EQ(table.valid(0).color, (std::array<std::uint8_t, 3>{1, 2, 3}));
    EXPECT_TRUE(reader->has(frame_of("a")));
    EXPECT_FALSE(reader->has(frame_of("b"))) << "its click was undone";
    EXPECT_EQ(rows_of(reader->read(frame_of("a"), table)), (Rows{"0.0.", ".000", "..0."}));
    // At another loaded size.
    EXPECT_EQ(rows_of(reader->read(frame_of("a", 8, 6), table))[0], "........");
  }
}

// --- scene.labels.clicks and class_room ---

// Frames a and b train, 4 x 3 pixels; a has labels of its own: wall everywhere.
LoadedScene loaded_scene(bool own) {
  LoadedScene scene;
  if (own) scene.info.classes = room_table();
  for (const char* name : {"a", "b"}) {
    scene.info.frames.push_back(frame_of(name));
    scene.info.frames.back().has_labels = own && name[0] == 'a';
    FrameBuffer buffer{.width_px = 4, .height_px = 3};
    buffer.rgb.assign(36, 0);
    if (scene.info.frames.back().has_labels) buffer.label.assign(12, 0);
    scene.frames.emplace_back(buffer);
    scene.class_pixels.push_back(buffer.label.empty() ? std::vector<std::int64_t>{}
                                                      : std::vector<std::int64_t>{12, 0, 0, 0});
  }
  return scene;
}

Rows rows_of_frame(const TrainingLabels& labels, std::size_t frame) {
  std::vector<std::int16_t> hard;
  for (std::size_t p = 0; p < labels.frames[frame].size(); ++p) hard.push_back(labels.frames[frame][p]);
  return rows_of({4, 3, hard, {}});
}

TEST(ClickedLabels, ArePaintedOverThoseOfTheConfiguration) {
  LoadedScene scene = loaded_scene(true);
  LabelConfig config{.selection = {.clicks = log_file(kLog)}};
  Diagnostics diagnostics;
  open_label_files(scene, config, diagnostics);
  EXPECT_EQ(names_of_table(scene.info.classes), "0-void 1=wall 4=chair 7=table 8=light ");
  EXPECT_EQ(scene.class_pixels[0], (std::vector<std::int64_t>{12, 0, 0, 0, 0}));
  TrainingLabels labels = make_training_labels(scene, config, diagnostics);
  EXPECT_EQ(rows_of_frame(labels, 0), (Rows{"3030", "0333", "0030"}));
  EXPECT_EQ(labels.class_pixels[0], (std::vector<std::int64_t>{6, 0, 0, 6, 0}));
  EXPECT_TRUE(labels.frames[1].empty());
  EXPECT_EQ(labels.unclicked[0].hard.expand(), std::vector<std::int16_t>(12, 0));
  config.selection.frames = "none";
  labels = make_training_labels(scene, config, diagnostics);
  EXPECT_EQ(rows_of_frame(labels, 0), (Rows{"3.3.", ".333", "..3."}));
  EXPECT_TRUE(diagnostics.all().empty());
}

TEST(ClickedLabels, OverSoftOnesAreSure) {
  TrainingLabels labels;
  labels.frames.resize(2);
  labels.class_pixels.resize(2);
  LoadedScene scene = loaded_scene(true);
  Annotations clicks(scene.info, 0);
  labels.frames[0].soft = SoftMap(12, 3);
  for (std::size_t p = 0; p < 12; ++p) labels.frames[0].soft.set_row(p, std::vector<float>{0.25F, 0.75F, 0});
  labels.unclicked = labels.frames;
  LabelEvent event = parse_label_event(
      R"({"id":"2","type":"click","frame":"a","size":[4,3],"points":[[0.5,0.5]],"radius":0,"class":"table"})");
  clicks.apply(event);
  event.id = "3";
  event.class_name = "void";
  event.points = {{3.5, 2.5}};
  clicks.apply(event);
  paint_clicks(clicks, 0, labels);
  EXPECT_EQ(rows_of_frame(labels, 0), (Rows{"2111", "1111", "111."}));
  EXPECT_EQ(labels.frames[0].soft.at(0, 2), 1.0F);
  EXPECT_EQ(labels.frames[0].soft.at(1, 1), 0.75F);
  EXPECT_FALSE(labels.frames[0].soft.labelled(11));
}

TEST(ClickedLabels, RoomWaitsForNames) {
  LoadedScene scene = loaded_scene(false);
  LabelConfig config{.selection = {.clicks = fresh_folder("none") + "/clicks.jsonl", .class_room = 3}};
  Diagnostics diagnostics;
  open_label_files(scene, config, diagnostics);
  EXPECT_EQ(names_of_table(scene.info.classes), "0-void 1=unnamed 1 2=unnamed 2 3=unnamed 3 ");
  const TrainingLabels labels = make_training_labels(scene, config, diagnostics);
  EXPECT_TRUE(labels.frames[0].empty());
  EXPECT_TRUE(diagnostics.all().empty());
  // A log that adds more classes than there was room for has room.
  LoadedScene more = loaded_scene(true);
  config.selection.class_room = 1;
  config.selection.clicks = log_file(kLog);
  open_label_files(more, config, diagnostics);
  EXPECT_EQ(names_of_table(more.info.classes), "0-void 1=wall 4=chair 7=table 8=light ");
}

}  // namespace
}  // namespace semfield
