// Label events: their text there and back, and what is refused.
#include <gtest/gtest.h>

#include <limits>

#include "core/error.h"
#include "labels/clicks/label_event.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using testing_room::error_of;

const std::string kClick =
    R"({"id":"a1-17","type":"click","frame":"rgb_12","size":[320,240],"points":[[12.5,33.0]],"radius":4,"class":"chair"})";

std::string refusal(const std::string& json) {
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
  EXPECT_EQ(label_event_json(click).find("fill"), std::string::npos);  // an older program reads it, too

  for (LabelEvent event : {click, made, renamed, skip, merged, deleted, outline,
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
      {click_with("[12.5,33.0]", "[12.5]"), "event: 'points': point 1 is no pair of numbers [x, y]: a list of 1"},
      {click_with("[12.5,33.0]", "[1,2],[3,\"4\"]"), "event: 'points': point 2 is no pair of numbers [x, y]"},
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
    EXPECT_TRUE(refusal(json).find(said) == 0) << json << "\n" << refusal(json) << "\n" << said;
  std::string many;
  for (std::size_t i = 0; i <= kMostEventPoints; ++i) many += i == 0 ? "[1,1]" : ",[1,1]";
  EXPECT_EQ(refusal(click_with("[12.5,33.0]", many))
                .find("event: 'points': expected a list of 1 to 4096 points, got a list of 4097"),
            0u);
}

TEST(LabelEvent, DeepNestingIsRefusedWithoutACrash) {
  EXPECT_NE(refusal(std::string(kMostEventBytes, '[')).find("event: not valid JSON"), std::string::npos);
  const std::string deep = std::string(100000, '[') + std::string(100000, ']');
  EXPECT_NE(refusal(click_with("[12.5,33.0]", deep)), "");
}

}  // namespace
}  // namespace semfield
