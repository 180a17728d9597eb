// `scene.labels.from: {type: clicks}` of a log of label events, and scene.labels.clicks and .class_room over labels.
#include "labels/clicks/click_log.h"
#include "labels/training_labels.h"
#include "system/files.h"
#include "tests/labels/reader_case.h"

namespace semfield {
namespace {

using namespace testing_labels;
using testing_room::fresh_folder;

const std::string kLog =
    R"({"id":"1","type":"class","name":"lamp","color":[1,2,3]})"
    "\n"
    R"({"id":"2","type":"click","frame":"a","size":[8,6],"points":[[1,1]],"radius":0,"class":"lamp"})"
    "\n"
    R"({"id":"3","type":"click","frame":"a","size":[4,3],"points":[[2.5,1.5]],"radius":1,"class":"lamp"})"
    "\n"
    R"({"id":"4","type":"rename","class":"lamp","name":"light"})"
    "\n"
    R"({"id":"5","type":"click","frame":"b","size":[4,3],"points":[[0,0]],"radius":0,"class":"light"})"
    "\n"
    R"({"id":"6","type":"undo","of":"5"})"
    "\n";

std::string log_file(const std::string& text, const std::string& name = "clicks.jsonl") {
  const std::string path = fresh_folder("click_reader") + "/" + name;
  testing_room::plain_write(path, text);
  return path;
}

std::string names_of_table(const ClassTable& table) {
  std::string out;
  for (const ClassEntry& e : table.entries()) out += std::to_string(e.id) + "=" + e.name + " ";
  return out;
}

TEST(ClickReader, ReadsALogOfTheLabellingPage) {
  for (const char* name : {"clicks.jsonl", "other.txt"}) {  // by its extension, or by what is in it
    const auto reader = make_reader("clicks", "file: " + log_file(kLog, name));
    Diagnostics diagnostics;
    const ClassTable table = open_for(*reader, {}, {frame_of("a"), frame_of("b")}, diagnostics);
    EXPECT_TRUE(diagnostics.all().empty());
    EXPECT_TRUE(reader->adds_classes());
    EXPECT_EQ(names_of_table(table), "0=void 1=light ");
    EXPECT_EQ(table.valid(0).color, (std::array<std::uint8_t, 3>{1, 2, 3}));
    EXPECT_TRUE(reader->has(frame_of("a")));
    EXPECT_FALSE(reader->has(frame_of("b"))) << "its click was undone";
    EXPECT_EQ(rows_of(reader->read(frame_of("a"), table)), (Rows{"0.0.", ".000", "..0."}));
    // At another loaded size.
    EXPECT_EQ(rows_of(reader->read(frame_of("a", 8, 6), table))[0], "........");
  }
}

TEST(ClickReader, ClassesOfALogStandBehindThoseOfTheScene) {
  const auto reader = make_reader("clicks", "file: " + log_file(kLog));
  Diagnostics diagnostics;
  const ClassTable table = open_for(*reader, room_table(), {frame_of("a")}, diagnostics);
  EXPECT_EQ(names_of_table(table), "0=void 1=wall 4=chair 7=table 8=light ");
  EXPECT_EQ(rows_of(reader->read(frame_of("a"), table)), (Rows{"3.3.", ".333", "..3."}));
}

TEST(ClickReader, NamesTheLineOfABadEvent) {
  const std::string path = log_file(kLog + R"({"id":"7","type":"undo","of":"5"})" + "\n");
  EXPECT_EQ(open_findings(*make_reader("clicks", "file: " + path), {}),
            "thrown: " + path + ":7: event '7': event '5' is undone already; undo its undo to bring it back");
  const std::string none = log_file(R"({"id":"1","type":"class","name":"lamp"})" + std::string("\n"));
  EXPECT_EQ(open_findings(*make_reader("clicks", "file: " + none), {}),
            none + ": no clicks in it; label the scene with `semfield serve`");
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
  EXPECT_EQ(names_of_table(scene.info.classes), "0=void 1=wall 4=chair 7=table 8=light ");
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
  EXPECT_EQ(names_of_table(scene.info.classes), "0=void 1=unnamed 1 2=unnamed 2 3=unnamed 3 ");
  const TrainingLabels labels = make_training_labels(scene, config, diagnostics);
  EXPECT_TRUE(labels.frames[0].empty());
  EXPECT_TRUE(diagnostics.all().empty());
  // A log that adds more classes than there was room for has room.
  LoadedScene more = loaded_scene(true);
  config.selection.class_room = 1;
  config.selection.clicks = log_file(kLog);
  open_label_files(more, config, diagnostics);
  EXPECT_EQ(names_of_table(more.info.classes), "0=void 1=wall 4=chair 7=table 8=light ");
}

TEST(ClickedLabels, ATornLineIsTold) {
  LoadedScene scene = loaded_scene(true);
  LabelConfig config{.selection = {.clicks = log_file(kLog + "{\"id\":\"7")}};
  Diagnostics diagnostics;
  open_label_files(scene, config, diagnostics);
  ASSERT_EQ(diagnostics.all().size(), 1u);
  EXPECT_EQ(diagnostics.all()[0].text(), "scene.labels.clicks: " + config.selection.clicks +
                                             ":7: the last line is torn, as a kill leaves an event that was not yet "
                                             "acknowledged; it is dropped; check the last click");
}

}  // namespace
}  // namespace semfield
