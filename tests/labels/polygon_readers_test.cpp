// labelme and COCO: shapes to pixels, names to classes, every refusal.
#include "core/rng.h"
#include "labels/mask_outlines.h"
#include "tests/labels/reader_case.h"

namespace semfield {
namespace {

using namespace testing_labels;
using testing_room::fresh_folder;

// --- filling ---

Rows filled(const Outline& outline, int width, int height) {
  LabelRaster raster = void_raster(width, height);
  paint(outline_runs(outline, width, height), 1, raster);
  return rows_of(raster);
}

TEST(OutlineFill, ThePixelCentreDecides) {
  EXPECT_EQ(filled({{0.6, 0.6}, {3.4, 0.6}, {3.4, 2.4}, {0.6, 2.4}}, 4, 3), (Rows{"....", ".11.", "...."}));
  EXPECT_EQ(filled({{0.4, 0.4}, {2.6, 0.4}, {2.6, 1.6}, {0.4, 1.6}}, 4, 3), (Rows{"111.", "111.", "...."}));
  // A triangle: centres (x + .5, y + .5) with x + y + 1 < 4.
  EXPECT_EQ(filled({{0, 0}, {4, 0}, {0, 4}}, 4, 4), (Rows{"111.", "11..", "1...", "...."}));
}

TEST(OutlineFill, NeighboursShareNoPixelAndLeaveNoneOut) {
  // A fan of triangles around a point that is a pixel centre, its corners on pixel centres too.
  const std::vector<PixelPoint> rim{{0.5, 0.5}, {4.5, 0.5}, {8.5, 0.5}, {8.5, 4.5},
                                    {8.5, 8.5}, {4.5, 8.5}, {0.5, 8.5}, {0.5, 4.5}};
  std::vector<int> count(9 * 9);
  for (std::size_t i = 0; i < rim.size(); ++i) {
    for (const PixelRun& run : outline_runs({{4.5, 4.5}, rim[i], rim[(i + 1) % rim.size()]}, 9, 9)) {
      for (int x = run.x0; x < run.x1; ++x) ++count[run.y * 9 + x];
    }
  }
  for (int y = 0; y < 9; ++y) {
    for (int x = 0; x < 9; ++x) EXPECT_EQ(count[y * 9 + x], x < 8 && y < 8 ? 1 : 0);
  }
}

TEST(OutlineFill, EvenOddAndPartsOutsideTheImage) {
  // An outline that winds twice around the middle leaves it out.
  EXPECT_EQ(filled({{0, 0}, {5, 0}, {5, 5}, {0, 5}, {0, 0}, {1, 1}, {4, 1}, {4, 4}, {1, 4}, {1, 1}}, 5, 5),
            (Rows{"11111", "1...1", "1...1", "1...1", "11111"}));
  EXPECT_EQ(filled({{-1e6, -1e6}, {1e6, -1e6}, {1e6, 1e6}, {-1e6, 1e6}}, 3, 2), (Rows{"111", "111"}));
  EXPECT_EQ(filled({{10, 10}, {20, 10}, {20, 20}}, 3, 2), (Rows{"...", "..."}));
  EXPECT_TRUE(outline_runs({}, 3, 2).empty());
  LabelRaster disc = void_raster(5, 5);
  paint(disc_runs({2.5, 2.5}, 1.0, 5, 5), 1, disc);
  EXPECT_EQ(rows_of(disc), (Rows{".....", "..1..", ".111.", "..1..", "....."}));
  EXPECT_TRUE(disc_runs({-9, 2}, 1, 5, 5).empty());
}

// --- labelme ---

std::string shape(const std::string& label, const std::string& type, const std::string& points) {
  return R"({"label": ")" + label + R"(", "shape_type": ")" + type + R"(", "points": )" + points + "}";
}
std::string labelme(const std::string& shapes, const std::string& image = "x/rgb_3.jpg") {
  return R"({"imagePath": ")" + image + R"(", "imageWidth": 6, "imageHeight": 4, "imageData": null, "shapes": [)" +
         shapes + "]}";
}

struct LabelmeCase {
  std::string folder = fresh_folder("t");
  std::unique_ptr<LabelReader> reader = make_reader("labelme", "folder: " + folder);
  void write(const std::string& name, const std::string& text) const { write_file_atomic(folder + "/" + name, text); }
};

TEST(Labelme, ShapesAreFilledInTheirOrder) {
  LabelmeCase c;
  c.write("rgb_3.json",
          labelme(shape("wall", "polygon", "[[0,0],[6,0],[6,4],[0,4]]") + "," +
                  shape("chair", "rectangle", "[[4,3],[1,1]]") + "," +
                  shape("table", "circle", "[[4.5,2.5],[5.5,2.5]]") + "," + shape("void", "point", "[[6,0.2]]")));
  EXPECT_EQ(rows_of(read_labels(*c.reader, frame_of("rgb_3"), room_table())),
            (Rows{"00000.", "011120", "011222", "000020"}));
}

TEST(Labelme, FramesAreFoundByImageOrFileAndTheTableIsBuiltInOrderOfNames) {
  LabelmeCase c;
  c.write("mine.json", labelme(shape("table", "point", "[[0.5,0.5]]") + "," + shape("chair", "point", "[[1,1]]"),
                               "..\\\\images\\\\0017.png"));
  c.write("other.json", labelme("", "0018.png"));
  c.write("settings.json", "{\"a\": 1}");
  Diagnostics d;
  const ClassTable table = open_for(*c.reader, {}, {frame_of("0017"), frame_of("0018"), frame_of("0019")}, d);
  ASSERT_EQ(d.all().size(), 2u);
  EXPECT_EQ(d.all()[1].code, Code("labels.frame.folder")) << "images is not nowhere";
  EXPECT_EQ(d.all()[0].text(), c.folder + "/settings.json: no labelme file (it has no 'shapes'); left out");
  ASSERT_EQ(table.entries().size(), 3u);
  EXPECT_EQ(table.entries()[1].name, "chair");
  EXPECT_EQ(table.entries()[1].id, 1);
  EXPECT_TRUE(table.entries()[0].ignore);
  EXPECT_TRUE(c.reader->has(frame_of("0017")));
  EXPECT_FALSE(c.reader->has(frame_of("0018"))) << "nothing is drawn in it";
  EXPECT_FALSE(c.reader->has(frame_of("0019")));
  FrameInfo renamed = frame_of("a");
  renamed.source = "/images/0017.jpg";
  Diagnostics others;
  c.reader->match({renamed}, others);
  EXPECT_EQ(rows_of(c.reader->read(renamed, table))[0], "1.....");
  c.reader->match({frame_of("mine")}, others);
  EXPECT_TRUE(c.reader->has(frame_of("mine")));
  EXPECT_TRUE(others.all().empty());
  EXPECT_HAS(error_of([&] { (void)c.reader->read(frame_of("0019"), table); }),
             "there is no labelme file for frame '0019'");
}

TEST(Labelme, VoidWordsOfToolsAreVoid) {
  LabelmeCase c;
  c.write("rgb_3.json", labelme(shape("chair", "rectangle", "[[0,0],[6,4]]") + "," +
                                    shape("__ignore__", "rectangle", "[[0,0],[2,4]]"),
                                "rgb_3.png"));
  EXPECT_EQ(rows_of(read_labels(*c.reader, frame_of("rgb_3"), {}))[0], "..0000");
}

TEST(Labelme, EveryRefusalNamesFileAndShape) {
  LabelmeCase c;
  const std::string path = c.folder + "/a.json";
  const auto findings = [&](const std::string& text) {
    c.write("a.json", text);
    return open_findings(*c.reader, room_table());
  };
  const auto of_shape = [&](const std::string& s) { return findings(labelme(s)); };
  const std::string first = path + ": shape 1 ('chair'): ", again = "; save the file again in labelme";
  EXPECT_EQ(of_shape("3"), path + ": shape 1: the shape has no label; give every shape the name of a class");
  EXPECT_EQ(of_shape(R"({"label": "chair"})"), first + "the shape has no list 'points'");
  EXPECT_EQ(of_shape(shape("chair", "circle", "[[0,0]]")),
            first + "a circle of 1 points; give its centre and a point on it");
  EXPECT_EQ(of_shape(shape("chair", "point", "[]")), first + "a point of 0 points; give one point");
}

TEST(Labelme, ManyProblemsAreCounted) {
  LabelmeCase c;
  for (int i = 0; i < 30; ++i) c.write(std::to_string(i) + ".json", "[");
  Diagnostics d;
  (void)c.reader->open({}, d);
  ASSERT_EQ(d.all().size(), 21u);
  EXPECT_EQ(d.all()[20].text(), "10 further problems are not listed");
}

// --- COCO ---

const std::string kCategories =
    R"("categories": [{"id": 1, "name": "wall"}, {"id": 4, "name": "chair"}, {"id": 9, "name": "table"}])";

std::string coco(const std::string& annotations, const std::string& categories = kCategories) {
  return R"({"images": [{"id": 5, "file_name": "train/rgb_3.png", "width": 4, "height": 3},
    {"id": 6, "file_name": "rgb_4.png", "width": 4, "height": 3}], "annotations": [)" +
         annotations + "], " + categories + "}";
}
std::string note(int category, const std::string& segmentation, int image = 5) {
  return R"({"id": 1, "image_id": )" + std::to_string(image) + R"(, "category_id": )" + std::to_string(category) +
         R"(, "segmentation": )" + segmentation + "}";
}

struct CocoCase {
  std::string file = fresh_folder("t") + "/instances.json";
  std::unique_ptr<LabelReader> reader = make_reader("coco", "file: " + file);
  std::string findings(const std::string& text, const ClassTable& known = room_table()) {
    write_file_atomic(file, text);
    return open_findings(*reader, known);
  }
};

TEST(Coco, PolygonsAndBothRunLengthsAndSmallOnesStayVisible) {
  CocoCase c;
  // The chair comes first and is smaller than the wall. Counts go down the columns of a 4 x 3 image.
  const std::string wall = note(1, "[[0,0,4,0,4,3,0,3]]");
  for (const std::string chair :
       {"[[1,1,2,1,2,3,1,3],[3,0,4,0,4,1,3,1]]", R"({"size": [3, 4], "counts": [4, 2, 3, 1, 2]})",
        R"({"size": [3, 4], "counts": "423OO"})"}) {
    EXPECT_EQ(c.findings(coco(note(4, chair) + "," + wall)), "") << chair;
    EXPECT_EQ(rows_of(read_labels(*c.reader, frame_of("rgb_3"), room_table())), (Rows{"0001", "0100", "0100"}))
        << chair;
  }
  EXPECT_FALSE(c.reader->has(frame_of("rgb_4")));
  EXPECT_FALSE(c.reader->has(frame_of("rgb_5")));
}

TEST(Coco, WithoutATableIdsAreKept) {
  CocoCase c;
  ASSERT_EQ(c.findings(coco(note(9, "[[0,0,4,0,4,3,0,3]]"))), "");
  Diagnostics d;
  const ClassTable table = open_for(*c.reader, {}, {frame_of("rgb_3")}, d);
  EXPECT_EQ(table.index_of(9), 2);
  EXPECT_EQ(table.index_of(4), 1);
  EXPECT_EQ(table.index_of(0), kVoid);
  // With the scene's table it is the name that counts: table is 7 there.
  EXPECT_EQ(rows_of(c.reader->read(frame_of("rgb_3"), room_table()))[0], "2222");
  ASSERT_EQ(c.findings(coco(note(0, "[[0,0,4,0,4,3,0,3]]"), R"("categories": [{"id": 0, "name": "person"}])"), {}), "");
  const ClassTable zero = c.reader->open({}, d);
  EXPECT_EQ(zero.index_of(0), 0);
  EXPECT_EQ(zero.index_of(1), kVoid);
}

// As Roboflow writes them: a group that is called as its only class.
TEST(Coco, CategoriesOfOneNameAreOneClass) {
  CocoCase c;
  const std::string twins =
      R"("categories": [{"id": 0, "name": "Lodged"}, {"id": 1, "name": "Lodged"}, {"id": 2, "name": "_background_"}])";
  write_file_atomic(c.file, coco(note(1, "[[0,0,4,0,4,3,0,3]]") + "," + note(2, "[[0,0,1,0,1,1,0,1]]"), twins));
  Diagnostics d;
  const ClassTable table = open_for(*c.reader, {}, {frame_of("rgb_3")}, d);
  EXPECT_EQ(table.valid_count(), 1);
  EXPECT_EQ(table.index_of(1), 0) << "the id that labels have";
  EXPECT_EQ(table.index_of(2), kVoid);
  EXPECT_EQ(rows_of(c.reader->read(frame_of("rgb_3"), table))[0], ".000");
  EXPECT_EQ(unfound(d.all(), "classes.name.twice", {"categories 0 and 1", "'Lodged'", "id 1"}), "");
}

TEST(Coco, EveryRefusalNamesTheEntry) {
  CocoCase c;
  const std::string first = c.file + ": annotation 1: ";
  const std::string good = "[[0,0,4,0,4,3]]";
  EXPECT_EQ(c.findings(coco("{}")), first + "needs a whole number 'category_id'");
  EXPECT_EQ(c.findings(coco("7")), first + "needs a whole number 'category_id'");
  EXPECT_EQ(c.findings(coco(note(1, "[]") + "," + note(1, "null"))),
            c.file + ": 2 annotations have a box and no mask; left out; export masks or polygons for them");
  EXPECT_EQ(c.findings(coco(note(1, "{\"size\": [3, 4]}"))), first + "run lengths need 'counts', a list or a text");
  EXPECT_EQ(c.findings(coco(note(1, "{\"counts\": []}"))), first + "run lengths without a count");
  const std::string again = "; export the annotation again";
  const auto read = [&](const std::string& segmentation) {
    EXPECT_EQ(c.findings(coco(note(1, segmentation))), "");
    Diagnostics d;
    c.reader->match({frame_of("rgb_3")}, d);
    return error_of([&] { (void)c.reader->read(frame_of("rgb_3"), room_table()); });
  };
  EXPECT_EQ(read("{\"counts\": [4, 2]}"),
            first + "run lengths: they cover 6 of 12 pixels of an image of 4 x 3" + again);
  EXPECT_EQ(c.findings(coco("", R"("categories": [{"id": 4, "name": "a"}, {"id": 4, "name": "b"}, {"id": 5}])")),
            c.file + ": category 2: id 4 is given twice\n" + c.file + ": category 3: needs a text 'name'");
  EXPECT_EQ(c.findings(coco("", R"("categories": [{"id": 70000, "name": "a"}])"), {}),
            c.file + ": category 'a' has id 70000; ids run from 0 to 65535");
}

// Whichever is called more like the frame: the labels of the other would be gone.
TEST(Coco, TwoImagesOfOneFrameAreRefused) {
  FrameInfo frame = frame_of("rgb_3");
  frame.source = "/scene/train/rgb_3.png";
  const std::string own = "train/rgb_3.png";
  for (const std::string other : {"train/rgb_3.jpg", "rgb_3.png", "rgb_3", "scene/train/rgb_3.png"}) {
    for (const auto& [first, second] : {std::pair{own, other}, {other, own}}) {
      CocoCase c;
      std::string text = coco(note(1, "[[0,0,4,0,4,3]]") + "," + note(4, "[[0,0,4,0,4,3]]", 6));
      text.replace(text.find("rgb_4.png"), 9, second);
      text.replace(text.find(own), own.size(), first);
      write_file_atomic(c.file, text);
      Diagnostics d;
      open_for(*c.reader, room_table(), {frame}, d);
      EXPECT_FINDING(d, "labels.frame.twice", "image 2", "'" + second + "' is frame 'rgb_3', of which '" + first + "'");
      EXPECT_TRUE(d.has_errors()) << first;
    }
  }
}

TEST(Coco, RunLengthTextRoundTrips) {
  for (const std::vector<std::int64_t>& counts : {std::vector<std::int64_t>{0, 12},
                                                  {4, 2, 3, 1, 2},
                                                  {1, 1, 1, 1, 1, 1},
                                                  {1000000, 1, 5, 70000, 0, 3, 16, 31, 32, 1024, 15}}) {
    EXPECT_EQ(counts_of_text(text_of_counts(counts)), counts);
  }
  EXPECT_EQ(text_of_counts({4, 2, 3, 1, 2}), "423OO");
  EXPECT_HAS(error_of([] { (void)counts_of_text("4P"); }), "the text ends within a number");
  EXPECT_HAS(error_of([] { (void)counts_of_text("ooooooooooooo0"); }), "number 1 is too large");
  EXPECT_HAS(error_of([] { (void)counts_of_text("O"); }), "count 1 is negative");
}

// Whatever bytes are damaged, opening and reading end with an Error, with problems or with labels, never otherwise.
TEST(PolygonReaders, DamageNeverCrashes) {
  LabelmeCase labelme_case;
  CocoCase coco_case;
  const std::string shapes = labelme(shape("wall", "polygon", "[[0,0],[6,0],[6,4]]") + "," +
                                     shape("table", "circle", "[[4.5,2.5],[5.5,2.5]]"));
  const std::string masks =
      coco(note(1, R"({"size": [3, 4], "counts": "423OO"})") + "," +
           note(4, R"({"size": [3, 4], "counts": [4, 2, 3, 1, 2]})") + "," + note(9, "[[0,0,4,0,4,3,0,3]]"));
  int refused = 0;
  for (std::uint64_t trial = 0; trial < 400; ++trial) {
    const RandomAddress address{trial, 0, stream_id("damage")};
    const auto damaged = [&](std::string text) {
      for (std::uint64_t k = 0; k < 1 + trial % 3; ++k)
        text[uniform_below(address, 2 * k, text.size())] =
            "0123456789-.e[]{}\",:x"[uniform_below(address, 2 * k + 1, 22)];
      return text;
    };
    testing_room::plain_write(labelme_case.folder + "/rgb_3.json", damaged(shapes));
    testing_room::plain_write(coco_case.file, damaged(masks));
    for (LabelReader* reader : {labelme_case.reader.get(), coco_case.reader.get()}) {
      const std::string error = error_of([&] {
        Diagnostics d;
        (void)open_for(*reader, room_table(), {frame_of("rgb_3")}, d);
        d.throw_if_errors(ErrorKind::data, "problems:");
        if (reader->has(frame_of("rgb_3"))) (void)reader->read(frame_of("rgb_3"), room_table());
      });
      refused += error.empty() ? 0 : 1;
    }
  }
  EXPECT_GT(refused, 200);
}

}  // namespace
}  // namespace semfield
