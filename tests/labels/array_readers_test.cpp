// Label images, class probabilities and clicks: values to classes, names of files, every refusal.
#include "formats/image_io.h"
#include "formats/npz.h"
#include "tests/labels/reader_case.h"

namespace semfield {
namespace {

using namespace testing_labels;
using testing_room::fresh_folder;

// --- images ---

std::unique_ptr<LabelReader> images(const std::string& folder, const std::string& rest) {
  return make_reader("images", "folder: " + folder + "\n" + rest + "\n");
}

TEST(LabelImages, IdsPalettesAndColours) {
  const std::string folder = fresh_folder("t");
  const std::vector<std::uint8_t> ids{0, 1, 4, 7};
  write_png_gray8(folder + "/semantic_class_12.png", 2, 2, ids);
  auto reader = images(folder, "pattern: 'semantic_class_{number}.png'");
  EXPECT_EQ(rows_of(read_labels(*reader, frame_of("rgb_12"), room_table())), (Rows{".0", "12"}));
  EXPECT_FALSE(reader->has(frame_of("rgb_1")));
  EXPECT_FALSE(reader->has(frame_of("rgb"))) << "no number";

  const std::vector<std::uint8_t> palette(8 * 3, 200);
  write_png_palette(folder + "/p.png", 2, 2, ids, palette);
  reader = images(folder, "kind: palette\npattern: '{stem}.png'");
  FrameInfo frame = frame_of("a/b");
  frame.source = "/x/p.jpg";
  EXPECT_EQ(rows_of(read_labels(*reader, frame, room_table())), (Rows{".0", "12"}));

  const std::vector<std::uint8_t> rgb{0, 0, 0, 10, 20, 30, 40, 50, 60, 70, 80, 90};
  write_png_rgb(folder + "/c.png", 2, 2, rgb);
  reader = images(folder, "kind: color");
  EXPECT_EQ(rows_of(read_labels(*reader, frame_of("c"), room_table())), (Rows{".0", "12"}));
  write_file_atomic(folder + "/colors.csv", std::string_view("r,g,b,name\n0,0,0,table\n10,20,30,\"chair\"\n40,50,60,"
                                                             "void\n70,80,90,chair\n"));
  reader = images(folder, "kind: color\nfile: " + folder + "/colors.csv");
  EXPECT_EQ(rows_of(read_labels(*reader, frame_of("c"), room_table())), (Rows{"21", ".1"}));
  // Without a table of the scene: names in the order of the file, with its colours.
  Diagnostics d;
  const ClassTable table = open_for(*reader, {}, {frame_of("c")}, d);
  ASSERT_EQ(table.valid_count(), 2);
  EXPECT_EQ(table.valid(0).name, "table");
  EXPECT_EQ(table.valid(1).color, (std::array<std::uint8_t, 3>{10, 20, 30}));
  EXPECT_EQ(rows_of(reader->read(frame_of("c"), table)), (Rows{"01", ".1"}));
}

TEST(LabelImages, ColumnsOfTheTableOfColoursAreReadByTheirNames) {
  const std::string folder = fresh_folder("t");
  const std::vector<std::uint8_t> rgb{1, 2, 3, 10, 20, 30};
  write_png_rgb(folder + "/c.png", 2, 1, rgb);
  write_file_atomic(folder + "/colors.csv",
                    std::string_view("id,name,red,green,blue\n0,__ignore__,1,2,3\n1,chair,10,20,30\n"));
  auto reader = images(folder, "kind: color\nfile: " + folder + "/colors.csv");
  EXPECT_EQ(rows_of(read_labels(*reader, frame_of("c", 2, 1), room_table())), (Rows{".1"}));
  write_file_atomic(folder + "/colors.csv", std::string_view("name,red,green\nchair,10,20\n"));
  EXPECT_HAS(open_findings(*reader, room_table()), "colors.csv:1: expected columns r, g, b and name");
  write_file_atomic(folder + "/colors.csv", std::string_view("1,2,3,chair,4\n"));
  EXPECT_HAS(open_findings(*reader, room_table()), "colors.csv:1: 5 columns, at most 4 are read");
}

TEST(LabelImages, AClassTableForASceneWithoutOne) {
  const std::string folder = fresh_folder("t");
  write_file_atomic(folder + "/classes.csv", std::string_view("class_id,class\n0,void\n1,wall\n5,lamp\n"));
  const std::vector<std::uint8_t> ids{0, 1, 5, 9};
  write_png_gray8(folder + "/a.png", 2, 2, ids);
  auto reader = images(folder, "unknown: void\nclasses: " + folder + "/classes.csv");
  EXPECT_EQ(rows_of(read_labels(*reader, frame_of("a"), {})), (Rows{".0", "1."}));
}

TEST(LabelImages, RefusalsNameFileAndPixel) {
  const std::string folder = fresh_folder("t");
  const std::vector<std::uint8_t> ids{0, 1, 4, 9};
  write_png_gray8(folder + "/a.png", 2, 2, ids);
  const std::vector<std::uint8_t> rgb{0, 0, 0, 10, 20, 30, 40, 50, 60, 70, 80, 91};
  write_png_rgb(folder + "/c.png", 2, 2, rgb);
  write_file_atomic(folder + "/broken.png", std::string_view("nothing"));
  const auto read = [&](const std::string& rest, const std::string& name) {
    auto reader = images(folder, rest);
    Diagnostics d;
    const ClassTable table = open_for(*reader, room_table(), {frame_of(name)}, d);
    return error_of([&] { (void)reader->read(frame_of(name), table); });
  };
  EXPECT_EQ(read("kind: palette", "broken"),
            "'" + folder + "/broken.png': it is not a PNG with a palette; set kind: ids or color");
  EXPECT_HAS(read("", "broken"), "broken.png");

  const auto opened = [&](const std::string& rest, const ClassTable& known = room_table()) {
    return open_findings(*images(folder, rest), known);
  };
  const auto colors = [&](const std::string& text, const ClassTable& known = room_table()) {
    write_file_atomic(folder + "/c.csv", text);
    return opened("kind: color\nfile: " + folder + "/c.csv", known);
  };
  const std::string csv = folder + "/c.csv";
  EXPECT_EQ(colors("1,2,3\n"), csv + ":1: expected 'r,g,b,name'");
  EXPECT_EQ(colors("1,2,3,wal\n"), csv + ":1: no class 'wal'; did you mean 'wall'?");
  EXPECT_EQ(colors("1,2,3,\"wall\n"), csv + ":1: a quote is not closed; end the field with a double quote");
  EXPECT_EQ(colors("\n"), csv + ": no colours in it; write lines 'r,g,b,name'");
  EXPECT_EQ(opened("", {}), "classes: the scene has no class table; name one in scene.labels.from.classes");
  EXPECT_HAS(opened("classes: " + folder + "/none.csv", {}), "none.csv");
  EXPECT_EQ(opened("kind: color", ClassTable({{1, "a", {1, 1, 1}, false}, {2, "b", {1, 1, 1}, false}})),
            "class table: 'a' and 'b' have the same colour (1, 1, 1); give each class its own colour, or name a table "
            "of colours in scene.labels.from.file");
  EXPECT_EQ(open_findings(*images(folder + "/none", ""), room_table()),
            "folder: '" + folder + "/none' is not a folder; check the path");
}

// --- class probabilities ---

struct NpzCase {
  std::string folder = fresh_folder("t");
  NpzCase() { classes(R"(["table", "other", "wall"])"); }
  void classes(const std::string& text) const { write_file_atomic(folder + "/classes.json", text); }
  // 1 x 2 pixels.
  void write(const std::vector<float>& values, std::int64_t columns = 3) const {
    const NpzEntry entry{"probability", {1, 2, columns}, values};
    const std::vector<float> confidence{1.0F, 0.5F};
    const NpzEntry second{"confidence", {1, 2}, confidence};
    const std::vector<NpzEntry> entries{entry, second};
    write_npz(folder + "/a.npz", entries);
  }
  std::unique_ptr<LabelReader> reader(const std::string& rest = "") const {
    return make_reader("npz", "folder: " + folder + "\n" + rest);
  }
  std::string read_error(const std::string& rest = "") const {
    auto r = reader(rest);
    Diagnostics d;
    const ClassTable table = open_for(*r, room_table(), {frame_of("a", 4, 2)}, d);
    for (const Diagnostic& x : d.all()) ADD_FAILURE() << x.text();
    return error_of([&] { (void)r->read(frame_of("a", 4, 2), table); });
  }
};

TEST(NpzLabels, ColumnsGoToTheirClasses) {
  const NpzCase c;
  c.write({0.5F, 0.25F, 0.25F, 0, 0, 0});
  const LabelRaster raster = read_labels(*c.reader(), frame_of("a", 4, 2), room_table());
  EXPECT_EQ(raster.width_px, 2);
  EXPECT_EQ(raster.height_px, 1);
  EXPECT_TRUE(raster.hard.empty());
  EXPECT_EQ(raster.soft, (std::vector<float>{0.25F, 0, 0.5F, 0, 0, 0}));
  for (const char* order : {R"({"table": 0, "other": 1, "wall": 2})", R"({"0": "table", "1": "other", "2": "wall"})"}) {
    c.classes(order);
    EXPECT_EQ(read_labels(*c.reader(), frame_of("a", 4, 2), room_table()).soft, raster.soft) << order;
  }
  c.write({0.5F, 0.25F, 0.25F, 0, 0, 1});
  EXPECT_EQ(read_labels(*c.reader("confidence_key: confidence"), frame_of("a", 4, 2), room_table()).soft,
            (std::vector<float>{0.25F, 0, 0.5F, 0.5F, 0, 0}));
  // Without a table of the scene: names in the order of the file; "other" is void.
  Diagnostics d;
  const auto reader = c.reader();
  const ClassTable table = open_for(*reader, {}, {frame_of("a", 4, 2)}, d);
  ASSERT_EQ(table.valid_count(), 2);
  EXPECT_EQ(table.valid(0).name, "table");
  EXPECT_EQ(reader->read(frame_of("a", 4, 2), table).soft, (std::vector<float>{0.5F, 0.25F, 0, 1}));
  EXPECT_FALSE(reader->has(frame_of("b", 4, 2)));
}

TEST(NpzLabels, RefusalsNameFileAndPixel) {
  const NpzCase c;
  const std::string file = "'" + c.folder + "/a.npz'", softmax =
                                                           "; save probabilities (after softmax): not negative, in "
                                                           "all at most 1";
  c.write({0.5F, 0.25F, 0.25F, 1, 2, 3});
  EXPECT_EQ(c.read_error(), file + ": pixel x 1, y 0: the classes add up to 6.000000" + softmax);
  c.write({0.5F, -0.25F, 0.25F, 0, 0, 0});
  EXPECT_EQ(c.read_error(), file + ": pixel x 0, y 0: class 'other' has -0.250000" + softmax);
  c.write({std::numeric_limits<float>::quiet_NaN(), 0, 0, 0, 0, 0});
  EXPECT_EQ(c.read_error(), file + ": pixel x 0, y 0: class 'table' has nan" + softmax);
  c.write({std::numeric_limits<float>::infinity(), 0, 0, 0, 0, 0});
  EXPECT_EQ(c.read_error(), file + ": pixel x 0, y 0: the classes add up to inf" + softmax);
  c.write({0.5F, 0.5F, 0, 0}, 2);
  EXPECT_EQ(c.read_error(), file + ", entry 'probability': 2 classes, '" + c.folder +
                                "/classes.json' names 3; name every class of the last axis, in its order");
  EXPECT_EQ(c.read_error("key: logits"), file + ": no array 'logits' in it; it has: probability, confidence");
  EXPECT_EQ(c.read_error("key: confidence"),
            file + ", entry 'confidence': the shape is (1, 2); save an array [height, width, classes]");
  c.write({0.5F, 0.25F, 0.25F, 0, 0, 0});
  EXPECT_HAS(c.read_error("confidence_key: probability"), file, "entry 'probability'", "(1, 2, 3)",
             "save a confidence [height, width]");
  {
    // Another shape than the frame's is found in its header, before any value is looked at.
    auto r = c.reader();
    Diagnostics d;
    const ClassTable table = open_for(*r, room_table(), {frame_of("a", 4, 3)}, d);
    EXPECT_EQ(error_of([&] { (void)r->read(frame_of("a", 4, 3), table); }),
              file +
                  ", entry 'probability': labels are 2 x 1 pixels, the frame is 4 x 3: another shape; label the "
                  "image of this frame");
  }
  testing_room::cut(c.folder + "/a.npz", 40);
  EXPECT_EQ(c.read_error(), file +
                                ": not a zip archive: its end is missing; save the file again, or copy it "
                                "again in full");

  const auto opened = [&](const std::string& order) {
    c.classes(order);
    return open_findings(*c.reader(), room_table());
  };
  const std::string path = c.folder + "/classes.json",
                    remedy = "; write a list of the class names in the order of the array's last axis";
  EXPECT_EQ(opened("[").find(path + ": not valid JSON: parse error at line 1, column 2"), 0u);
  EXPECT_EQ(opened("[]"), path + ": no class names in it" + remedy);
  EXPECT_EQ(opened("[\"wall\", 3]"), path + ": entry 2 is not text" + remedy);
  EXPECT_EQ(opened("[\"wall\", \"wall\"]"), path + ": class 'wall' is named twice" + remedy);
  EXPECT_EQ(opened("{\"wall\": 0, \"table\": 0}"), path + ": column 0 is given twice" + remedy);
  EXPECT_EQ(opened("{\"wall\": null}"),
            path + ": 'wall' is neither a name with a column nor a column with a name" + remedy);
  EXPECT_HAS(error_of([&] { (void)c.reader("pattern: '{name}.npy'\nconfidence_key: c"); }), "a .npy file holds one");
  EXPECT_HAS(error_of([&] { (void)c.reader("key: ''"); }), "no array is named");
}

// --- clicks ---

TEST(Clicks, PixelsAndDiscsInAVoidImage) {
  const std::string file = fresh_folder("t") + "/clicks.csv";
  auto reader = make_reader("clicks", "file: " + file);
  write_file_atomic(
      file, std::string_view("frame,x,y,class,radius\nrgb_1,3,0,table,1\n\nrgb_1,0,2,\"wall\"\nrgb_1,1,2,void,\n"));
  EXPECT_EQ(rows_of(read_labels(*reader, frame_of("rgb_1"), room_table())), (Rows{"..22", "...2", "0..."}));
  EXPECT_FALSE(reader->has(frame_of("rgb_2")));
  // A frame loaded at half its stored size: coordinates are those of the stored image, and no click gets lost.
  const std::string stored = fresh_folder("images") + "/rgb_1.png";
  write_png_gray8(stored, 8, 6, std::vector<std::uint8_t>(48));
  write_file_atomic(file, std::string_view("rgb_1,7,5,table\nrgb_1,0,0,chair\n"));
  FrameInfo frame = frame_of("rgb_1");
  frame.source = stored;
  EXPECT_EQ(rows_of(read_labels(*reader, frame, room_table())), (Rows{"1...", "....", "...2"}));
  Diagnostics d;
  const ClassTable table = reader->open({}, d);
  EXPECT_EQ(table.valid(0).name, "chair");
  EXPECT_EQ(table.valid(1).name, "table");
}

// Other refusals of every reader are cases of tests/bad_files/labels.cases.
TEST(Clicks, RefusalsNameTheLine) {
  const std::string file = fresh_folder("t") + "/clicks.csv";
  auto reader = make_reader("clicks", "file: " + file);
  const auto findings = [&](const std::string& text) {
    write_file_atomic(file, text);
    return open_findings(*reader, room_table());
  };
  const std::string remedy = "; write lines 'frame,x,y,class' or 'frame,x,y,class,radius'";
  EXPECT_EQ(findings("# mine\n,1,2,wall\n"), file + ":2: no frame is named" + remedy);
  EXPECT_EQ(findings("a,1,,wall\n"), file + ":1: y: expected a whole number of pixels, got ''" + remedy);
  EXPECT_EQ(findings("a,1,2,\n"), file + ":1: no class is named" + remedy);
  EXPECT_HAS(findings("a,1,2,wall,3,4\n"), file + ":1: 6 columns, at most 5 are read");
  EXPECT_HAS(findings("image,row,col,label\na,2,1,wall,3\n"), file + ":2: 5 columns, the first line names 4");
  EXPECT_HAS(findings("image,row,label\na,2,wall\n"), file + ":1: expected columns frame, x, y and class");
  EXPECT_EQ(findings("image,row,col,label\na,2,1,wall\n"), "");
  ASSERT_EQ(findings("a,1,2,wall\n"), "");
  EXPECT_HAS(error_of([&] { (void)reader->read(frame_of("zz"), room_table()); }), "no click in frame 'zz'");
  std::filesystem::remove(file);
  EXPECT_EQ(open_findings(*reader, room_table()).find("thrown: cannot open"), 0u);
}

}  // namespace
}  // namespace semfield
