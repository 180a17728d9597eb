// Class probabilities, outlines to pixels, label files to frames, labels that train. Label images, clicks, labelme and
// COCO: tests/bad_files/labels.cases.

#include <algorithm>
#include <set>

#include "core/rng.h"
#include "formats/image_io.h"
#include "formats/npz.h"
#include "labels/frame_match.h"
#include "labels/label_files.h"
#include "labels/mask_outlines.h"
#include "labels/training_labels.h"
#include "scene/loading/posed_photographs.h"
#include "tests/labels/reader_case.h"
#include "tests/scene/npz_files.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_labels;
using testing_room::fresh_folder;

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

// Values and shapes that are wrong: tests/bad_files/labels.cases.
TEST(NpzLabels, AnArrayThatIsNotThereIsNamed) {
  const NpzCase c;
  const std::string file = "'" + c.folder + "/a.npz'";
  c.write({0.5F, 0.25F, 0.25F, 0, 0, 0});
  EXPECT_HAS(c.read_error("key: logits"), file, "'logits'", "probability, confidence");
  EXPECT_HAS(c.read_error("key: confidence"), file + ", entry 'confidence'", "(1, 2)");
  EXPECT_HAS(c.read_error("confidence_key: probability"), file, "entry 'probability'", "(1, 2, 3)");
}

// --- filling ---

// By hand: tests/bad_files/labels.cases.
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

TEST(OutlineFill, OfNothingIsNothing) {
  EXPECT_TRUE(outline_runs({}, 3, 2).empty());
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

// --- COCO ---

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

// Label files find the pictures that they are of, and no others: rigs of cameras, prefixes of tools, files of no frame.

FrameInfo frame_at(const std::string& name, const std::string& source) {
  FrameInfo frame = frame_of(name);
  frame.source = source;
  return frame;
}

// Two cameras whose images have the same names, as datasets name their frames.
std::vector<FrameInfo> rig(int views = 2) {
  std::vector<FrameInfo> frames;
  for (const std::string side : {"left", "right"}) {
    for (int i = 1; i <= views; ++i) {
      const std::string number = "000" + std::to_string(i);
      frames.push_back(
          frame_at(side == "left" ? number : side + "_" + number, "/s/images/" + side + "/" + number + ".png"));
    }
  }
  return frames;
}

struct Matched {
  std::string frames;  // "frame=picture ..."
  Diagnostics found;
  std::string said() const { return all_said(found); }
};

Matched matched(const std::vector<FrameInfo>& frames, const std::vector<std::string>& names) {
  std::vector<PictureName> pictures;
  for (const std::string& name : names) pictures.push_back({.path = name, .place = "place of " + name});
  Matched out;
  for (const auto& [frame, picture] : match_frames(pictures, frames, "labels.json", out.found))
    out.frames += frame + "=" + names[picture] + " ";
  return out;
}

TEST(FrameMatch, PicturesOfOneCameraAreNeverThoseOfAnother) {
  const Matched left = matched(rig(), {"left/0001.png", "left\\0002.png"});
  EXPECT_EQ(left.frames, "0001=left/0001.png 0002=left\\0002.png ");
  EXPECT_TRUE(left.found.all().empty()) << left.said();
  const Matched deep = matched(rig(), {"/home/me/images/right/0002.jpg", "./left/0002"});
  EXPECT_EQ(deep.frames, "0002=./left/0002 right_0002=/home/me/images/right/0002.jpg ");
  // Its own frame is not in the scene; the other camera's of the same number is.
  std::vector<FrameInfo> short_left = rig();
  short_left.erase(short_left.begin() + 1);
  const Matched lost = matched(short_left, {"left/0001.png", "left/0002.png"});
  EXPECT_EQ(lost.frames, "0001=left/0001.png ");
  EXPECT_FINDING(lost.found, "labels.frame.unmatched", "1 of 2", "'left/0002.png'");
  // One camera alone is loaded, and the labels are of both.
  const std::vector<FrameInfo> right{frame_at("0001", "/s/right/0001.png"), frame_at("0002", "/s/right/0002.png")};
  EXPECT_EQ(matched(right, {"left/0001.png", "right/0001.png", "left/0002.png"}).frames, "0001=right/0001.png ");
}

// EuRoC: the camera's folder is two above.
TEST(FrameMatch, FoldersMayBeLeftOutInBetween) {
  const std::vector<FrameInfo> frames{frame_at("14", "/s/mav0/cam0/data/14.png"),
                                      frame_at("data_14", "/s/mav0/cam1/data/14.png")};
  EXPECT_EQ(matched(frames, {"cam1/14.png"}).frames, "data_14=cam1/14.png ");
  EXPECT_EQ(matched(frames, {"mav0/cam0/14.png"}).frames, "14=mav0/cam0/14.png ");
  EXPECT_TRUE(matched(frames, {"data/14.png"}).found.has_errors());
  // Images made smaller lie in a folder of another name.
  const std::vector<FrameInfo> small{frame_at("1", "/s/images_4/left/1.png"),
                                     frame_at("right_1", "/s/images_4/right/1.png")};
  const Matched both = matched(small, {"images/right/1.png", "images/left/1.png"});
  EXPECT_EQ(both.frames, "1=images/left/1.png right_1=images/right/1.png ");
  EXPECT_TRUE(both.found.all().empty()) << both.said();
}

TEST(FrameMatch, AmbiguityIsAnErrorThatListsTheFrames) {
  const Matched bare = matched(rig(), {"0001.png", "0002.png"});
  EXPECT_EQ(bare.frames, "");
  EXPECT_FINDING(bare.found, "labels.frame.ambiguous", "place of 0001.png", "'images/left/0001.png'",
                 "'images/right/0001.png'");
  EXPECT_EQ(bare.found.error_count(), 2);
  EXPECT_TRUE(matched(rig(), {"train/0001.png"}).found.has_errors()) << "a folder that no image is in tells nothing";
  // A name that only a frame has shows that names of frames are meant.
  EXPECT_EQ(matched(rig(), {"0001.png", "right_0001.png"}).frames, "0001=0001.png right_0001=right_0001.png ");
  // The extension decides between two images of one folder.
  const std::vector<FrameInfo> both{frame_at("a", "/s/a.jpg"), frame_at("s_a", "/s/a.png")};
  EXPECT_EQ(matched(both, {"a.png"}).frames, "s_a=a.png ");
  EXPECT_FINDING(matched({frame_at("x", "/s/a.png")}, {"a.jpg", "a.tif"}).found, "labels.frame.twice", "a.jpg", "a.tif",
                 "'x'");
}

TEST(FrameMatch, AnotherNameDecidesWhereTheFirstDoesNot) {
  Diagnostics found;
  const std::vector<PictureName> pictures{{.path = "0001.png", .place = "a", .other = "right_0001.json"},
                                          {.path = "moved.png", .place = "b", .other = "left/0002.json"},
                                          {.path = "0001.png", .place = "c", .file = "/s/images/left/0001.png"}};
  EXPECT_EQ(match_frames(pictures, rig(), "f", found),
            (std::map<std::string, std::size_t>{{"right_0001", 0}, {"0002", 1}, {"0001", 2}}));
  EXPECT_TRUE(found.all().empty());
}

TEST(FrameMatch, LabelsOfNoFrameAreCountedAndNamedWithTheLikelyFrame) {
  std::vector<FrameInfo> frames;
  std::vector<std::string> names;
  for (int i = 0; i < 6; ++i) {
    const std::string stem = "IMG_" + std::to_string(i);
    frames.push_back(frame_at(stem, "/s/images/" + stem + ".png"));
    names.push_back(i % 2 == 1 ? stem + ".png" : i == 0 ? "8f2c1a3b-IMG_0.png" : stem + "_png.rf.0a1b2c.jpg");
  }
  const Matched half = matched(frames, names);
  EXPECT_EQ(half.frames, "IMG_1=IMG_1.png IMG_3=IMG_3.png IMG_5=IMG_5.png ");
  EXPECT_FINDING(half.found, "labels.frame.unmatched", "3 of 6", "'8f2c1a3b-IMG_0.png', meant for frame 'IMG_0'?",
                 "'IMG_2_png.rf.0a1b2c.jpg', meant for frame 'IMG_2'?");
  EXPECT_EQ(half.found.all().at(0).severity, Severity::warning);
  // Labels of more pictures than the scene has: told, but nothing is wrong with their names.
  const Matched more = matched(frames, {"IMG_1.png", "IMG_77.png"});
  EXPECT_FINDING(more.found, "labels.frame.unmatched", "1 of 2", "'IMG_77.png'");
  EXPECT_EQ(more.found.all().at(0).severity, Severity::note);
  // A folder of another name is reported, as a note where no folder tells images apart.
  const Matched other = matched(frames, {"upload/IMG_1.png", "upload/IMG_2.png"});
  EXPECT_EQ(other.frames, "IMG_1=upload/IMG_1.png IMG_2=upload/IMG_2.png ");
  EXPECT_FINDING(other.found, "labels.frame.folder", "2 pictures", "'upload/IMG_1.png'");
}

TEST(FrameMatch, NamesOfExportsAreFoundAgain) {
  const std::string folder = fresh_folder("t");
  std::vector<FrameInfo> frames{frame_at("a b", "nothing")};
  for (const char* side : {"left", "right"}) {
    std::filesystem::create_directories(folder + "/" + side);
    for (const char* name : {"1", "2"}) {
      if (side[0] == 'l' && name[0] == '2') continue;
      const std::string path = folder + "/" + side + "/" + name + ".png";
      write_png_gray8(path, 1, 1, std::vector<std::uint8_t>(1));
      frames.push_back(frame_at(std::string(side) + name, path));
    }
  }
  const std::vector<std::string> names = picture_names(frames);
  EXPECT_EQ(names, (std::vector<std::string>{"a b.png", "left/1.png", "right/1.png", "2.png"}));
  EXPECT_EQ(matched(frames, names).frames, "a b=a b.png left1=left/1.png right1=right/1.png right2=2.png ");
}

// Files of label images by a pattern.
struct FileCase {
  std::string folder = fresh_folder("t");
  void put(const std::string& name) const {
    std::filesystem::create_directories(std::filesystem::path(folder + "/" + name).parent_path());
    testing_room::plain_write(folder + "/" + name, "x");
  }
  std::string read(const std::vector<FrameInfo>& frames, const std::string& pattern, Diagnostics& found) const {
    std::string out;
    for (const auto& [frame, path] : match_files(folder, pattern, frames, found))
      out += frame + "=" + path.substr(folder.size() + 1) + " ";
    return out;
  }
};

TEST(FilesOfFrames, FoldersOfTheImagesGoBefore) {
  const FileCase c;
  for (const char* name : {"left/0001.png", "images/right/0001.png", "right/0001.png", "right/0002.png"}) c.put(name);
  for (const char* pattern : {"{name}.png", "{stem}.png", "{number}.png"}) {
    Diagnostics found;
    EXPECT_EQ(c.read(rig(), pattern, found),
              "0001=left/0001.png right_0001=images/right/0001.png right_0002=right/0002.png ");
    EXPECT_FALSE(found.has_errors()) << pattern;
  }
}

TEST(FilesOfFrames, OneOfSeveralFramesIsAnError) {
  const FileCase c;
  c.put("0001.png");
  for (const char* pattern : {"{name}.png", "{stem}.png", "{number}.png"}) {
    Diagnostics found;
    (void)c.read(rig(), pattern, found);
    EXPECT_FINDING(found, "labels.frame.ambiguous", "/s/images/left/0001.png", "/s/images/right/0001.png");
  }
  c.put("right_0001.png");
  Diagnostics named;
  EXPECT_EQ(c.read(rig(), "{name}.png", named), "0001=0001.png right_0001=right_0001.png ") << "names of frames";
  EXPECT_FALSE(named.has_errors());
  Diagnostics stems;  // two images have this one
  (void)c.read(rig(), "{stem}.png", stems);
  EXPECT_FINDING(stems, "labels.frame.ambiguous", "/s/images/left/0001.png", "/s/images/right/0001.png");
}

// Every reader on a rig of which one camera is labelled.
TEST(LabelReaders, KeepCamerasApart) {
  const std::string folder = fresh_folder("t");
  const std::vector<FrameInfo> frames = rig(1);
  const auto reads = [&](const std::string& type, const std::string& yaml) {
    const auto reader = make_reader(type, yaml);
    Diagnostics found;
    (void)open_for(*reader, room_table(), frames, found);
    for (const Diagnostic& d : found.all()) ADD_FAILURE() << type << ": " << d.text();
    return std::to_string(reader->has(frames[0])) + std::to_string(reader->has(frames[1]));
  };
  write_file_atomic(folder + "/coco.json",
                    std::string_view(R"({"images": [{"id": 1, "file_name": "left/0001.png", "width": 4, "height": 3}],
  "categories": [{"id": 1, "name": "wall"}],
  "annotations": [{"image_id": 1, "category_id": 1, "segmentation": [[0, 0, 4, 0, 4, 3]]}]})"));
  EXPECT_EQ(reads("coco", "file: " + folder + "/coco.json"), "10");
  const std::string shapes =
      R"("imageWidth": 4, "imageHeight": 3, "shapes": [{"label": "wall", "shape_type": "point", "points": [[1, 1]]}]})";
  for (const std::string image : {"../images/left/0001.png", "0001.png"}) {
    std::filesystem::create_directories(folder + "/labelme/left");
    write_file_atomic(folder + "/labelme/left/0001.json", R"({"imagePath": ")" + image + "\", " + shapes);
    EXPECT_EQ(reads("labelme", "folder: " + folder + "/labelme"), "10") << image;
  }
  for (const char* name : {"/ids/left", "/soft/left"}) std::filesystem::create_directories(folder + name);
  write_png_gray8(folder + "/ids/left/0001.png", 4, 3, std::vector<std::uint8_t>(12, 1));
  EXPECT_EQ(reads("images", "folder: " + folder + "/ids"), "10");
  write_file_atomic(folder + "/soft/classes.json", std::string_view(R"(["wall"])"));
  const std::vector<float> sure(12, 1.0F);
  const std::vector<NpzEntry> entries{{"probability", {3, 4, 1}, sure}};
  write_npz(folder + "/soft/left/0001.npz", entries);
  EXPECT_EQ(reads("npz", "folder: " + folder + "/soft"), "10");
  write_file_atomic(folder + "/clicks.csv", std::string_view("left/0001,1,1,wall\n"));
  EXPECT_EQ(reads("clicks", "file: " + folder + "/clicks.csv"), "10");
  // A log of the page names frames as the run does: the left one's name is the stem of both.
  write_file_atomic(
      folder + "/clicks.jsonl",
      std::string_view(
          R"({"id":"1","type":"click","frame":"0001","size":[4,3],"points":[[1,1]],"radius":0,"class":"wall"})"
          "\n"));
  EXPECT_EQ(reads("clicks", "file: " + folder + "/clicks.jsonl"), "10");
}

std::string mask_of(FrameMasks& masks, const std::string& image) {
  FrameFiles files;
  files.color = image;
  masks.add_to(files);
  return files.mask;
}

TEST(FrameMasks, OfTwoCamerasAreNotShared) {
  const FileCase c;
  c.put("masks/0001.png");
  FrameMasks flat(c.folder, "masks");
  EXPECT_NE(mask_of(flat, "/s/images/left/0001.jpg"), "");
  EXPECT_NE(mask_of(flat, "/s/images/right/0001.jpg"), "");
  Diagnostics found;
  flat.report(found);
  EXPECT_FINDING(found, "scene.mask.ambiguous", "/s/images/left/0001.jpg", "/s/images/right/0001.jpg");
  c.put("masks/a/left/0001.png");
  c.put("masks/b/left/0001.png");
  FrameMasks deep(c.folder, "masks");
  EXPECT_EQ(mask_of(deep, "/s/b/left/0001.jpg"), c.folder + "/masks/b/left/0001.png");
  EXPECT_EQ(mask_of(deep, "/s/a/left/0001.jpg"), c.folder + "/masks/a/left/0001.png");
}

// Which labels train: the scene's own or those of files, scaled, selected, degraded; the truth stays.

ClassTable two_classes() {
  return ClassTable({{0, "void", {}, true}, {4, "wall", {}, false}, {9, "chair", {}, false}});
}

// Frames a and b train, t tests; 4 x 2 pixels.
LoadedScene tiny_scene(bool with_labels) {
  LoadedScene scene;
  if (with_labels) scene.info.classes = two_classes();
  for (const char* name : {"a", "b", "t"}) {
    FrameInfo f{.name = name, .camera = {.width_px = 4, .height_px = 2}, .has_labels = with_labels};
    f.split = f.name == "t" ? Split::test : Split::train;
    scene.info.frames.push_back(f);
    FrameBuffer b{.width_px = 4, .height_px = 2};
    b.rgb.assign(24, 0);
    if (with_labels) b.label = {0, 0, 1, kVoid, 1, 1, 1, 1};
    scene.frames.emplace_back(b);
    scene.class_pixels.push_back(with_labels ? std::vector<std::int64_t>{2, 5, 1} : std::vector<std::int64_t>{});
  }
  return scene;
}

// 8 x 4 pixels, twice the frames' size: class 1 in the right half.
struct Files final : LabelReader {
  bool soft = false;
  void describe(ParamVisitor&) override {}
  ClassTable open(const ClassTable&, Diagnostics&) override { return two_classes(); }
  bool has(const FrameInfo& frame) const override { return frame.name != "a"; }
  LabelRaster read(const FrameInfo&, const ClassTable& classes) const override {
    LabelRaster out{8, 4, {}, {}};
    for (int i = 0; i < 32; ++i) {
      const int c = i % 8 < 4 ? 0 : 1;
      if (soft) {
        for (int k = 0; k < classes.valid_count(); ++k) out.soft.push_back(k == c ? 0.5F : 0.25F);
      } else {
        out.hard.push_back(static_cast<std::int16_t>(c));
      }
    }
    return out;
  }
};

struct VoidFirst final : Degradation {
  void describe(ParamVisitor&) override {}
  StepFacts apply(const LoadedScene&, std::uint64_t seed, LabelSet& labels) const override {
    for (FrameLabels& f : labels) {
      if (!f.hard.empty()) f.hard[0] = kVoid;
    }
    return {{"seed", std::to_string(seed)}};
  }
};

LabelConfig files_config(bool soft = false) {
  LabelConfig config;
  auto reader = std::make_unique<Files>();
  reader->soft = soft;
  config.from = {"files", std::move(reader)};
  return config;
}

TEST(TrainingLabels, SelectionAndDegradationLeaveTheTruthAlone) {
  const LoadedScene scene = tiny_scene(true);
  LabelConfig config{.selection = {.frames = "1", .seed = 7}};
  config.degrade.push_back({"void_first", std::make_unique<VoidFirst>()});
  Diagnostics d;
  const TrainingLabels labels = make_training_labels(scene, config, d);
  EXPECT_EQ(labels.frames[0][0], kVoid);
  EXPECT_EQ(labels.frames[0][1], 0);
  EXPECT_TRUE(labels.frames[1].empty());
  EXPECT_EQ(scene.frames[0].label[0], 0);
  ASSERT_EQ(labels.steps.size(), 1u);
  EXPECT_EQ(labels.steps[0].facts[0].second, "7");
  EXPECT_EQ(labels.class_pixels[0], (std::vector<std::int64_t>{1, 5, 2}));
}

TEST(TrainingLabels, ATypeNamedAgainDrawsAnew) {
  const LoadedScene scene = tiny_scene(true);
  LabelConfig config{.selection = {.seed = 7}};
  for (const char* type : {"void_first", "other", "void_first"})
    config.degrade.push_back({type, std::make_unique<VoidFirst>()});
  Diagnostics d;
  const TrainingLabels labels = make_training_labels(scene, config, d);
  EXPECT_EQ(labels.steps[0].facts[0].second, "7");
  EXPECT_EQ(labels.steps[1].facts[0].second, "7");
  EXPECT_EQ(labels.steps[2].facts[0].second, std::to_string(7 + (std::int64_t{1} << 53)));
}

TEST(TrainingLabels, FilesReplaceTrainingLabelsAndGiveTestFramesTheirTruth) {
  LoadedScene scene = tiny_scene(false);
  LabelConfig config = files_config();
  Diagnostics d;
  open_label_files(scene, config, d);
  EXPECT_EQ(scene.info.classes.valid_count(), 2);
  read_test_labels(scene, config, d);
  const TrainingLabels labels = make_training_labels(scene, config, d);
  EXPECT_FALSE(d.has_errors());
  EXPECT_TRUE(labels.frames[0].empty());
  const LabelMap halves(std::vector<std::int16_t>{0, 0, 1, 1, 0, 0, 1, 1});
  EXPECT_EQ(labels.frames[1].hard, halves);
  EXPECT_TRUE(labels.frames[2].empty());
  EXPECT_EQ(scene.frames[2].label, halves);
  EXPECT_TRUE(scene.info.frames[2].has_labels);
  // A scene with its own labels keeps them as the truth.
  LoadedScene own = tiny_scene(true);
  read_test_labels(own, config, d);
  EXPECT_EQ(own.frames[2].label[3], kVoid);
  EXPECT_EQ(make_training_labels(own, config, d).frames[1].hard, halves);
}

TEST(TrainingLabels, SoftFilesCountTheMostProbableClass) {
  LoadedScene scene = tiny_scene(true);
  const LabelConfig config = files_config(true);
  Diagnostics d;
  const TrainingLabels labels = make_training_labels(scene, config, d);
  EXPECT_TRUE(labels.soft);
  EXPECT_EQ(labels.frames[1][0], 0);
  EXPECT_EQ(labels.frames[1][3], 1);
  EXPECT_EQ(labels.frames[1].soft.at(0, 1), 0.25F);
  EXPECT_EQ(labels.class_pixels[1], (std::vector<std::int64_t>{4, 4, 0}));
}

TEST(SoftMap, HalvesAreNearestAndExact) {
  for (std::uint32_t h = 0; h < 0x10000u; ++h) {
    const float f = float_of_half(static_cast<std::uint16_t>(h));
    if (std::isnan(f)) continue;
    ASSERT_EQ(half_of(f), h);
  }
  EXPECT_EQ(half_of(65519.0F), 0x7BFF);
  EXPECT_EQ(half_of(65520.0F), 0x7C00);
  EXPECT_EQ(half_of(1.0F + 0x1p-11F), 0x3C00) << "a tie goes to the even half";
  EXPECT_EQ(half_of(1.0F + 3 * 0x1p-11F), 0x3C02);
  EXPECT_EQ(half_of(0x1.8p-25F), 1);  // subnormal
  EXPECT_TRUE(std::isnan(float_of_half(half_of(NAN))));
}

TEST(SoftMap, RefusesWhatIsNoProbability) {
  SoftMap map(2, 2);
  map.set_row(1, std::array<float, 2>{0.2F, 0.6F});
  EXPECT_EQ(map.argmax(0), kVoid);
  EXPECT_EQ(map.argmax(1), 1);
  EXPECT_THROW(map.set_row(0, std::array<float, 2>{-0.1F, 1}), Error);
  EXPECT_THROW(map.set_row(0, std::array<float, 2>{NAN, 1}), Error);
}

// Label selection: exact counts, spacing, determinism, refusals.

// 180 training frames 0, 5, ..., 895 and as many test frames, as in the paper.
SceneInfo paper_split() {
  SceneInfo info;
  for (int i = 0; i < 900; ++i) {
    if (i % 5 != 0 && i % 5 != 2) continue;
    FrameInfo f{
        .name = "rgb_" + std::to_string(i), .split = i % 5 == 0 ? Split::train : Split::test, .has_labels = true};
    info.frames.push_back(f);
  }
  return info;
}

TEST(LabelSelection, CountsAreExact) {
  for (const auto& [frames, count] :
       {std::pair{"all", 180}, {"none", 0}, {"10%", 18}, {"5%", 9}, {"0.1%", 1}, {"0%", 0}, {"100%", 180}, {"2", 2}})
    EXPECT_EQ(label_frame_count(frames, 180), count) << frames;
  EXPECT_EQ(label_frame_count("10%", 0), 0);
}

TEST(LabelSelection, EvenKeyFramesAreSpacedAndOnlyTrainingFrames) {
  const SceneInfo info = paper_split();
  LabelParams p{.frames = "10%"};
  const std::vector<int> keep = select_label_frames(info, p);
  ASSERT_EQ(keep.size(), 18u);
  for (std::size_t k = 0; k < keep.size(); ++k) EXPECT_EQ(info.frames[keep[k]].name, "rgb_" + std::to_string(50 * k));
}

TEST(LabelSelection, RandomIsSeededWithoutRepeats) {
  const SceneInfo info = paper_split();
  LabelParams p{.frames = "18", .mode = LabelMode::random};
  const std::vector<int> a = select_label_frames(info, p);
  EXPECT_EQ(a, select_label_frames(info, p));
  EXPECT_EQ(std::set<int>(a.begin(), a.end()).size(), 18u);
  for (const int i : a) EXPECT_EQ(info.frames[i].split, Split::train);
  p.seed = 2;
  EXPECT_NE(a, select_label_frames(info, p));
  p.seed = 1;
  p.frames = "40";
  const std::vector<int> larger = select_label_frames(info, p);
  for (const int i : a) EXPECT_TRUE(std::binary_search(larger.begin(), larger.end(), i));
}

TEST(LabelSelection, NamedFrames) {
  const SceneInfo info = paper_split();
  const LabelParams p{.mode = LabelMode::named, .names = {"rgb_100", "rgb_0", "rgb_100"}};
  const std::vector<int> keep = select_label_frames(info, p);
  ASSERT_EQ(keep.size(), 2u);
  EXPECT_EQ(info.frames[keep[1]].name, "rgb_100");
}

// Frame 0 shows classes 0 and 1, frame 1 class 2 alone, frame 2 classes 0, 1 and 3: 2 first, then 1.
TEST(LabelSelection, CoverageTakesTheFrameThatShowsMostNewClasses) {
  SceneInfo info;
  for (int i = 0; i < 4; ++i) {
    FrameInfo f{.split = i == 3 ? Split::test : Split::train, .has_labels = true};
    info.frames.push_back(f);
  }
  const std::vector<std::vector<std::int64_t>> pixels{
      {9, 9, 0, 0, 0}, {0, 0, 1, 0, 30}, {1, 1, 0, 1, 0}, {5, 5, 5, 5, 5}};
  LabelParams p{.frames = "1", .mode = LabelMode::coverage};
  EXPECT_EQ(select_label_frames(info, p, pixels), (std::vector<int>{2}));
  p.frames = "2";
  EXPECT_EQ(select_label_frames(info, p, pixels), (std::vector<int>{1, 2}));
  p.frames = "3";
  EXPECT_EQ(select_label_frames(info, p, pixels), (std::vector<int>{0, 1, 2}));
}

}  // namespace
}  // namespace semfield
