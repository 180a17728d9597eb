// Labels are drawn over pictures as viewers show them: every reader, every EXIF orientation, at every loaded size.
#include <algorithm>
#include <cmath>

#include "formats/npz.h"
#include "labels/training_labels.h"
#include "loading/frame_files.h"
#include "tests/labels/reader_case.h"
#include "tests/labels/turned_case.h"
#include "tests/program.h"

namespace semfield {
namespace {

using namespace testing_labels;
using testing_room::fresh_folder;

// A frame stored as w x h pixels, and its labels as shown: chair top left, table top right, the rest wall.
struct TurnedCase {
  int w, h, orientation;
  std::string folder;
  LoadedScene scene;

  TurnedCase(int width, int height, int turned, int divide = 1)
      : w(width), h(height), orientation(turned), folder(fresh_folder("t")) {
    const std::string image = folder + "/images/a.png";
    std::filesystem::create_directories(folder + "/images");
    write_png_rgb(image, w, h, std::vector<std::uint8_t>(static_cast<std::size_t>(3 * w * h), 99));
    set_orientation(image, orientation);
    FrameInfo frame{.name = "a", .source = image, .camera = {.width_px = w / divide, .height_px = h / divide}};
    frame.orientation = image_size(image).orientation;
    EXPECT_EQ(frame.orientation, orientation);
    scene.info.frames = {frame};
    scene.info.classes = room_table();
    scene.frames.resize(1);
    scene.class_pixels.resize(1);
  }
  int shown_w() const { return orientation >= 5 ? h : w; }
  int shown_h() const { return orientation >= 5 ? w : h; }
  std::vector<std::uint8_t> shown_ids() const {
    std::vector<std::uint8_t> ids(static_cast<std::size_t>(w * h), 1);
    ids[0] = 4;
    ids[static_cast<std::size_t>(shown_w() - 1)] = 7;
    return ids;
  }

  // Labels of the loaded frame, its pixels as stored.
  Rows read(const std::string& type, const std::string& yaml) {
    LabelConfig config;
    config.from = {type, make_reader(type, yaml)};
    Diagnostics found;
    open_label_files(scene, config, found);
    const TrainingLabels labels = make_training_labels(scene, config, found);
    for (const Diagnostic& d : found.all())
      if (d.severity != Severity::note) ADD_FAILURE() << d.text();
    const Camera& camera = scene.info.frames[0].camera;
    LabelRaster raster{camera.width_px, camera.height_px, {}, {}};
    for (std::size_t p = 0; p < labels.frames.at(0).size(); ++p) raster.hard.push_back(labels.frames[0][p]);
    return rows_of(raster);
  }
  Rows wanted() const {
    Rows rows(static_cast<std::size_t>(h), std::string(static_cast<std::size_t>(w), '0'));
    const ShownCorners at = shown_corners(orientation, w, h);
    rows[static_cast<std::size_t>(at.left_y)][static_cast<std::size_t>(at.left_x)] = '1';
    rows[static_cast<std::size_t>(at.right_y)][static_cast<std::size_t>(at.right_x)] = '2';
    return rows;
  }
  std::string size_keys(const char* width, const char* height) const {
    return std::string("\"") + width + "\": " + std::to_string(shown_w()) + ", \"" + height +
           "\": " + std::to_string(shown_h());
  }
};

TEST(TurnedPictures, EveryReaderUnderstandsThemAsShown) {
  for (const auto& [w, h] : {std::pair{5, 3}, std::pair{4, 4}}) {
    for (int orientation = 1; orientation <= 8; ++orientation) {
      TurnedCase c(w, h, orientation);
      const std::string told = std::to_string(w) + " x " + std::to_string(h) + ", " + std::to_string(orientation);
      const int right = c.shown_w();
      const std::string r0 = std::to_string(right - 1), r1 = std::to_string(right), all = std::to_string(c.shown_h());

      write_file_atomic(
          c.folder + "/coco.json",
          "{\"images\": [{\"id\": 1, \"file_name\": \"a.png\", " + c.size_keys("width", "height") +
              "}], \"categories\": [{\"id\": 1, \"name\": \"wall\"}, {\"id\": 4, \"name\": \"chair\"}, {\"id\": 7, "
              "\"name\": \"table\"}], \"annotations\": [{\"image_id\": 1, \"category_id\": 1, \"segmentation\": "
              "[[0,0," +
              r1 + ",0," + r1 + "," + all + ",0," + all +
              "]]}, {\"image_id\": 1, \"category_id\": 4, \"segmentation\": [[0,0,1,0,1,1,0,1]]}, {\"image_id\": 1, "
              "\"category_id\": 7, \"segmentation\": [[" +
              r0 + ",0," + r1 + ",0," + r1 + ",1," + r0 + ",1]]}]}");
      EXPECT_EQ(c.read("coco", "file: " + c.folder + "/coco.json"), c.wanted()) << told;

      std::filesystem::create_directories(c.folder + "/labelme");
      const auto box = [](const char* name, const std::string& corners) {
        return std::string("{\"label\": \"") + name + "\", \"shape_type\": \"rectangle\", \"points\": [" + corners +
               "]}";
      };
      write_file_atomic(c.folder + "/labelme/a.json",
                        "{\"imagePath\": \"../images/a.png\", " + c.size_keys("imageWidth", "imageHeight") +
                            ", \"shapes\": [" + box("wall", "[0,0],[" + r1 + "," + all + "]") + "," +
                            box("chair", "[0,0],[1,1]") + "," + box("table", "[" + r0 + ",0],[" + r1 + ",1]") + "]}");
      EXPECT_EQ(c.read("labelme", "folder: " + c.folder + "/labelme"), c.wanted()) << told;

      std::filesystem::create_directories(c.folder + "/ids");
      const std::vector<std::uint8_t> ids = c.shown_ids();
      write_png_gray8(c.folder + "/ids/a.png", c.shown_w(), c.shown_h(), ids);
      EXPECT_EQ(c.read("images", "folder: " + c.folder + "/ids"), c.wanted()) << told;

      std::filesystem::create_directories(c.folder + "/soft");
      write_file_atomic(c.folder + "/soft/classes.json", std::string_view(R"(["wall", "chair", "table"])"));
      std::vector<float> soft;
      for (const std::uint8_t id : ids)
        for (const int of : {1, 4, 7}) soft.push_back(id == of ? 1.0F : 0.0F);
      const std::vector<NpzEntry> entries{{"probability", {c.shown_h(), c.shown_w(), 3}, soft}};
      write_npz(c.folder + "/soft/a.npz", entries);
      EXPECT_EQ(c.read("npz", "folder: " + c.folder + "/soft"), c.wanted()) << told;

      write_file_atomic(c.folder + "/clicks.csv",
                        "x,y,frame,class,radius\n2,1,a,wall,99\n0,0,a,chair,\n" + r0 + ",0,a,table,\n");
      EXPECT_EQ(c.read("clicks", "file: " + c.folder + "/clicks.csv"), c.wanted()) << told;

      // The labelling page, and maps of `semfield render`, are of pixels as stored.
      const std::string size = "\"size\":[" + std::to_string(w) + "," + std::to_string(h) + "]";
      const auto click = [&](const char* id, const char* name, int x, int y, int radius) {
        return std::string("{\"id\":\"") + id + "\",\"type\":\"click\",\"frame\":\"a\"," + size + ",\"points\":[[" +
               std::to_string(x) + ".5," + std::to_string(y) + ".5]],\"radius\":" + std::to_string(radius) +
               ",\"class\":\"" + name + "\"}\n";
      };
      const ShownCorners at = shown_corners(orientation, w, h);
      write_file_atomic(c.folder + "/clicks.jsonl", click("1", "wall", 1, 1, 99) +
                                                        click("2", "chair", at.left_x, at.left_y, 0) +
                                                        click("3", "table", at.right_x, at.right_y, 0));
      EXPECT_EQ(c.read("clicks", "file: " + c.folder + "/clicks.jsonl"), c.wanted()) << told;

      std::filesystem::create_directories(c.folder + "/render");
      std::vector<std::uint8_t> stored;
      for (const std::string& row : c.wanted())
        for (const char index : row) stored.push_back(index == '0' ? 1 : index == '1' ? 4 : 7);
      write_png_gray8(c.folder + "/render/a_label.png", w, h, stored);
      write_file_atomic(c.folder + "/render/cameras.json", std::string_view("{\"format\": \"semfield-cameras-1\"}"));
      EXPECT_EQ(c.read("images", "{folder: " + c.folder + "/render, pattern: '{name}_label.png'}"), c.wanted()) << told;
    }
  }
}

// Loaded at half the size, in the quarter that is shown top left.
TEST(TurnedPictures, AreScaledAsTheyAreStored) {
  for (int orientation = 1; orientation <= 8; ++orientation) {
    TurnedCase c(8, 4, orientation, 2);
    const int across = c.shown_w(), down = c.shown_h();
    std::vector<std::uint8_t> ids(32, 1);
    for (int y = 0; y < down / 2; ++y)
      for (int x = 0; x < across / 2; ++x) ids[static_cast<std::size_t>(y * across + x)] = 4;
    std::filesystem::create_directories(c.folder + "/ids");
    write_png_gray8(c.folder + "/ids/a.png", across, down, ids);
    const ShownCorners at = shown_corners(orientation, 4, 2);
    Rows wanted(2, "0000");
    const std::size_t half = at.left_x == 0 ? 0 : 2;
    wanted[static_cast<std::size_t>(at.left_y)][half] = wanted[static_cast<std::size_t>(at.left_y)][half + 1] = '1';
    EXPECT_EQ(c.read("images", "folder: " + c.folder + "/ids"), wanted) << orientation;
  }
}

TEST(TurnedPictures, LabelsOfTheStoredPixelsAreRefusedWithTheRemedy) {
  TurnedCase c(5, 3, 6);
  std::filesystem::create_directories(c.folder + "/ids");
  write_png_gray8(c.folder + "/ids/a.png", 5, 3, c.shown_ids());
  LabelConfig config;
  config.from = {"images", make_reader("images", "folder: " + c.folder + "/ids")};
  Diagnostics found;
  open_label_files(c.scene, config, found);
  const std::string said = error_of([&] { (void)make_training_labels(c.scene, config, found); });
  EXPECT_HAS(said, "labels are 5 x 3 pixels, the frame is 3 x 5");
  EXPECT_HAS(said, "as shown, by its EXIF orientation 6");
  EXPECT_HAS(said, "exiftool -Orientation=");
}

// The scene's own label and instance images, which a person or a tool has drawn too.
TEST(TurnedPictures, LabelImagesOfTheSceneAreReadAsShown) {
  for (int orientation = 1; orientation <= 8; ++orientation) {
    TurnedCase c(5, 3, orientation);
    const std::string label = c.folder + "/label.png";
    const std::vector<std::uint8_t> ids = c.shown_ids();
    write_png_gray8(label, c.shown_w(), c.shown_h(), ids);
    const FrameFiles files{c.scene.info.frames[0].source, "", label, label};
    FrameInfo frame = c.scene.info.frames[0];
    frame.orientation = 1;
    Diagnostics found;
    FrameFileCheck check(MissingFiles::error, "");
    check.check_headers(frame, files, found);
    for (const Diagnostic& d : found.all()) ADD_FAILURE() << d.text();
    EXPECT_EQ(frame.orientation, orientation);
    FrameBuffer out;
    read_frame_files(frame, files, {}, room_table(), out);
    EXPECT_EQ(rows_of({5, 3, out.label, {}}), c.wanted()) << orientation;
    const ShownCorners at = shown_corners(orientation, 5, 3);
    EXPECT_EQ(out.instance[static_cast<std::size_t>(5 * at.left_y + at.left_x)], 4);
    EXPECT_EQ(out.instance[static_cast<std::size_t>(5 * at.right_y + at.right_x)], 7);
  }
}

using namespace testing_program;

// `render` shows pixels as stored; what is exported for tools, and what degrade writes, as the photograph is shown.
TEST(TurnedPictures, ExportsAreAsShownAndReadBack) {
  const std::string folder = fresh_folder("t");
  testing_room::write_replica(folder + "/room", 5);
  const std::vector<int> turns{3, 6, 8, 5, 7};
  std::filesystem::create_directories(folder + "/labels");
  for (int i = 0; i < 5; ++i) {
    const std::string name = std::to_string(i) + ".png", label = folder + "/room/semantic_class/semantic_class_" + name;
    const int turn = turns[static_cast<std::size_t>(i)];
    set_orientation(folder + "/room/rgb/rgb_" + name, turn);
    const Image<std::uint16_t> stored = read_ids(label);
    std::vector<std::uint8_t> shown(stored.pixels.size());
    const bool quarter = turn >= 5;
    for (int y = 0; y < 30; ++y) {
      for (int x = 0; x < 40; ++x) {
        const std::uint8_t id = static_cast<std::uint8_t>(stored.pixels[static_cast<std::size_t>(40 * y + x)]);
        // Turned by hand: 3 by half, 6 to the right, 8 to the left, 5 mirrored about one diagonal, 7 about the other.
        const int u = turn == 3 ? 39 - x : turn == 6 || turn == 7 ? 29 - y : y;
        const int v = turn == 3 ? 29 - y : turn == 8 || turn == 7 ? 39 - x : x;
        shown[static_cast<std::size_t>(v * (quarter ? 30 : 40) + u)] = id;
      }
    }
    write_png_gray8(folder + "/labels/" + name, quarter ? 30 : 40, quarter ? 40 : 30, shown);
  }
  for (const char* name : {"/room/semantic_class", "/room/semantic_instance"})
    std::filesystem::remove_all(folder + name);
  write_file_atomic(folder + "/room.yaml",
                    "include: " + std::string(SEMFIELD_SOURCE_DIR) +
                        "/configs/presets/room.yaml\nscene: {type: replica, root: room, train_step: 1, test_step: 0, "
                        "labels: {from: {type: images, folder: labels, pattern: '{number}.png'}}}\n");
  const Result degraded = semfield_run("degrade room.yaml --out given", folder);
  ASSERT_EQ(degraded.code, 0) << degraded.err;
  for (int i = 0; i < 5; ++i) {
    const std::string number = std::to_string(i);
    EXPECT_EQ(read_ids(folder + "/given/semantic_class/semantic_class_" + number + ".png").pixels,
              read_ids(folder + "/labels/" + number + ".png").pixels)
        << turns[static_cast<std::size_t>(i)];
  }
  const Result trained = semfield_run("train room.yaml --steps 20 --threads 1 --out run -q", folder);
  ASSERT_EQ(trained.code, 0) << trained.err;
  ASSERT_EQ(semfield_run("render run --split train --out rendered -q", folder).code, 0);
  const ClassTable table = ClassTable::load(folder + "/room/classes.yaml");
  for (const std::string format : {"coco", "labelme", "png"}) {
    const Result r =
        semfield_run("export run --split train --min-area 0 --format " + format + " --out " + format + ".x", folder);
    ASSERT_EQ(r.code, 0) << r.err;
    const std::string path = folder + "/" + format + ".x";
    for (int i = 0; i < 5; ++i) {
      const std::string name = "rgb_" + std::to_string(i);
      const int turn = turns[static_cast<std::size_t>(i)];
      const Image<std::uint16_t> stored = read_ids(folder + "/rendered/" + name + "_label.png");
      FrameInfo frame{.name = name, .source = folder + "/room/rgb/" + name + ".png"};
      frame.camera.width_px = turn >= 5 ? 30 : 40;
      frame.camera.height_px = turn >= 5 ? 40 : 30;
      auto reader = format == "coco" ? make_reader("coco", "file: " + path)
                    : format == "labelme"
                        ? make_reader("labelme", "folder: " + path)
                        : make_reader("images", "{folder: " + path + ", pattern: '{name}_label.png'}");
      const LabelRaster shown = read_labels(*reader, frame, table);
      ASSERT_EQ(shown.width_px, frame.camera.width_px) << format;
      int wrong = 0;
      for (int y = 0; y < 30; ++y) {
        for (int x = 0; x < 40; ++x) {
          const int u = turn == 3 ? 39 - x : turn == 6 || turn == 7 ? 29 - y : y;
          const int v = turn == 3 ? 29 - y : turn == 8 || turn == 7 ? 39 - x : x;
          wrong += shown.hard[static_cast<std::size_t>(v * shown.width_px + u)] !=
                   table.index_of(stored.pixels[static_cast<std::size_t>(40 * y + x)]);
        }
      }
      EXPECT_EQ(wrong, 0) << format << " " << turn;
    }
  }
  // A packed scene still knows how its photographs are shown.
  ASSERT_EQ(semfield_run("pack room.yaml --out room.sfpack", folder).code, 0);
  write_file_atomic(folder + "/packed.yaml",
                    "include: " + std::string(SEMFIELD_SOURCE_DIR) +
                        "/configs/presets/room.yaml\nscene: {type: packed, file: room.sfpack, labels: {from: {type: "
                        "images, folder: labels, pattern: '{number}.png'}}}\n");
  const Result packed = semfield_run("degrade packed.yaml --out again", folder);
  ASSERT_EQ(packed.code, 0) << packed.err;
  for (const char* number : {"0", "4"})
    EXPECT_EQ(read_ids(folder + "/again/semantic_class/semantic_class_" + number + ".png").pixels,
              read_ids(folder + "/labels/" + number + ".png").pixels);
}

// Frame 0 is shown upside down; the room's own label images are drawn over it so.
TEST(TurnedPictures, ProbabilitiesAndFusedMapsAreAsShown) {
  const std::string folder = fresh_folder("t");
  testing_room::write_replica(folder + "/room", 5);
  set_orientation(folder + "/room/rgb/rgb_0.png", 3);
  const auto write_config = [&](const std::string& labels) {
    write_file_atomic(folder + "/room.yaml", "include: " + std::string(SEMFIELD_SOURCE_DIR) +
                                                 "/configs/presets/room.yaml\nscene: {type: replica, root: room, "
                                                 "train_step: 2, test_step: 2, test_offset: 1" +
                                                 labels + "}\n");
  };
  write_config("");
  const Result fused = semfield_run("fuse room.yaml --method monocular --out maps", folder);
  ASSERT_EQ(fused.code, 0) << fused.err;
  EXPECT_EQ(read_ids(folder + "/maps/monocular/rgb_0_label.png").pixels,
            read_ids(folder + "/room/semantic_class/semantic_class_0.png").pixels);
  write_config(", labels: {degrade: [{type: simulated_predictions}]}");
  const Result degraded = semfield_run("degrade room.yaml --out given", folder);
  ASSERT_EQ(degraded.code, 0) << degraded.err;
  const std::vector<float> soft =
      read_npy(folder + "/given/probability/rgb_0.npy", [](std::span<const std::int64_t>) {}).values;
  const std::vector<std::uint16_t> ids = read_ids(folder + "/given/semantic_class/semantic_class_0.png").pixels;
  ASSERT_EQ(soft.size(), 6 * ids.size());
  for (std::size_t p = 0; p < ids.size(); ++p) {
    const auto row = soft.begin() + static_cast<std::ptrdiff_t>(6 * p);
    ASSERT_EQ(ids[p], std::max_element(row, row + 6) - row + 1) << p;
  }
}

}  // namespace
}  // namespace semfield
