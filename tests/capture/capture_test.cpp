// TIFF files by hand, with what a camera writes of itself.

#include <algorithm>
#include <cstdint>
#include <filesystem>
#include <map>
#include <nlohmann/json.hpp>
#include <set>
#include <string>
#include <vector>

#include "core/rng.h"
#include "formats/image_io.h"
#include "loading/capture/photographs.h"
#include "loading/capture/reconstruct.h"
#include "loading/colmap_model.h"
#include "scene/camera.h"
#include "tests/capture/model_files.h"
#include "tests/program.h"
#include "tests/scene/tiny_scene.h"

namespace semfield::testing_room {

/// An uncompressed RGB picture of one grey, with the tags Make, Model and, in the EXIF directory, FocalLength in tenths
/// of a millimetre [TIFF 6.0, Exif 2.3].
inline std::string tiff_of(std::uint32_t width, std::uint32_t height, const std::string& make, const std::string& model,
                           std::uint32_t focal_tenths) {
  struct Tag {
    std::uint16_t id, type;
    std::uint32_t count, value;
  };
  constexpr std::uint16_t kShort = 3, kLong = 4, kText = 2, kRational = 5;
  std::string out = "II*";
  out.push_back('\0');
  const auto put = [&](auto value) { out.append(reinterpret_cast<const char*>(&value), sizeof value); };
  const std::uint32_t pixels = 3 * width * height;
  const std::uint32_t of_make = 8 + pixels, of_model = of_make + static_cast<std::uint32_t>(make.size()) + 1,
                      of_bits = of_model + static_cast<std::uint32_t>(model.size()) + 1, of_focal = of_bits + 6,
                      of_exif = of_focal + 8, directory = of_exif + 18;
  put(directory);
  out.append(pixels, '\x60');
  out.append(make.c_str(), make.size() + 1);
  out.append(model.c_str(), model.size() + 1);
  for (int i = 0; i < 3; ++i) put(std::uint16_t{8});
  put(focal_tenths);
  put(std::uint32_t{10});
  const auto put_tags = [&](const std::vector<Tag>& tags) {
    put(static_cast<std::uint16_t>(tags.size()));
    for (const Tag& tag : tags) {
      put(tag.id);
      put(tag.type);
      put(tag.count);
      put(tag.value);
    }
    put(std::uint32_t{0});
  };
  put_tags({{37386, kRational, 1, of_focal}});
  put_tags({{256, kLong, 1, width},
            {257, kLong, 1, height},
            {258, kShort, 3, of_bits},
            {259, kShort, 1, 1},
            {262, kShort, 1, 2},
            {271, kText, static_cast<std::uint32_t>(make.size()) + 1, of_make},
            {272, kText, static_cast<std::uint32_t>(model.size()) + 1, of_model},
            {273, kLong, 1, 8},
            {277, kShort, 1, 3},
            {278, kLong, 1, height},
            {279, kLong, 1, pixels},
            {34665, kLong, 1, of_exif}});
  return out;
}

}  // namespace semfield::testing_room

namespace semfield {
namespace {

// The parts of capture: names and their order, photographs that do not belong together, pairs, sharp frames, what is
// said of photographs without a pose.

using namespace testing_room;

void photograph(const std::string& path, int width = 8, int height = 6) {
  std::filesystem::create_directories(std::filesystem::path(path).parent_path());
  write_png_rgb(path, width, height, std::vector<std::uint8_t>(static_cast<std::size_t>(3 * width * height), 90));
}

TEST(CaptureNames, NumbersInNamesAreNumbers) {
  std::vector<std::string> names{"b2.jpg", "10.jpg", "b10.jpg", "2.jpg", "02.jpg", "b.jpg", "2"};
  std::sort(names.begin(), names.end(), comes_before);
  EXPECT_EQ(names, (std::vector<std::string>{"2", "02.jpg", "2.jpg", "10.jpg", "b.jpg", "b2.jpg", "b10.jpg"}));
  for (const std::string& a : names) EXPECT_FALSE(comes_before(a, a));
}

TEST(CaptureSource, PhotographsOfAFolderOrOfItsFolders) {
  const std::string folder = fresh_folder("s");
  for (const char* name : {"1", "10", "2"}) photograph(folder + "/images/" + std::string(name) + ".png");
  plain_write(folder + "/images/notes.txt", "");
  const CaptureSource one = look_at_source(folder);
  ASSERT_EQ(one.photographs.size(), 3u);
  EXPECT_EQ(one.photographs[2].name, "10.png");
  EXPECT_FALSE(one.camera_per_folder);
  const std::string pair = fresh_folder("pair");
  for (const char* name : {"left/1", "left/2", "right/1"}) photograph(pair + "/" + name + ".png");
  const CaptureSource two = look_at_source(pair);
  ASSERT_EQ(two.photographs.size(), 3u);
  EXPECT_EQ(two.photographs[2].name, "right/1.png");
  EXPECT_TRUE(two.camera_per_folder);
  plain_write(folder + "/a.MOV", "");
  EXPECT_TRUE(look_at_source(folder + "/a.MOV").video);
}

TEST(CaptureSource, WhatIsNeitherIsRefused) {
  const std::string folder = fresh_folder("s");
  EXPECT_ERROR(look_at_source(folder), "capture.source.empty");
  EXPECT_ERROR(look_at_source(folder + "/none"), "files.folder.missing");
  plain_write(folder + "/a.txt", "");
  EXPECT_ERROR(look_at_source(folder + "/a.txt"), "capture.source.kind", "a.txt");
  plain_write(folder + "/walk.mp4", "");
  EXPECT_ERROR(look_at_source(folder), "capture.source.empty", folder + "/walk.mp4");
  plain_write(folder + "/IMG_1.HEIC", "");
  EXPECT_ERROR(look_at_source(folder), "capture.photographs.heic", "heif-convert");
}

TEST(CapturePhotographs, TwoSizesAreRefusedByName) {
  const std::string folder = fresh_folder("s");
  for (const char* name : {"a", "b", "c", "d"}) photograph(folder + "/" + std::string(name) + ".png");
  photograph(folder + "/turned.png", 6, 8);
  Diagnostics d;
  check_photographs(look_at_source(folder), d);
  ASSERT_EQ(d.error_count(), 1);
  EXPECT_FINDING(d, "capture.photographs.sizes", "1 of 6 x 8 (turned.png)", "4 of 8 x 6 (a.png, b.png, c.png, ...)");
  std::filesystem::create_directories(folder + "/apart/one");
  std::filesystem::create_directories(folder + "/apart/two");
  for (const char* name : {"a", "b", "c", "d"})
    std::filesystem::rename(folder + "/" + name + ".png", folder + "/apart/one/" + name + ".png");
  std::filesystem::rename(folder + "/turned.png", folder + "/apart/two/turned.png");
  Diagnostics apart;
  check_photographs(look_at_source(folder + "/apart"), apart);
  EXPECT_EQ(apart.error_count(), 0) << "each folder is a camera";
}

TEST(CapturePhotographs, TwoLensesOfOnePhoneAreTwoCameras) {
  if (!images_available()) GTEST_SKIP() << "this build reads no TIFF (SEMFIELD_WITH_IMAGES=OFF)";
  const std::string folder = fresh_folder("s");
  for (const char* name : {"a", "b", "c"})
    plain_write(folder + "/" + name + ".tif", tiff_of(8, 6, "Apple", "iPhone 12", 42));
  Diagnostics same;
  check_photographs(look_at_source(folder), same);
  EXPECT_TRUE(same.all().empty());
  plain_write(folder + "/wide.tif", tiff_of(8, 6, "Apple", "iPhone 12", 15));
  Diagnostics d;
  check_photographs(look_at_source(folder), d);
  EXPECT_FINDING(d, "capture.photographs.cameras", "1 of Apple iPhone 12 at 1.50 mm (wide.tif)",
                 "3 of Apple iPhone 12 at 4.20 mm (a.tif, b.tif, c.tif)");
}

TEST(CapturePhotographs, FewAndDamagedOnesAreNamed) {
  const std::string folder = fresh_folder("s");
  photograph(folder + "/a.png");
  plain_write(folder + "/b.png", "\x89PNG\r\n\x1a\n cut");
  Diagnostics d;
  check_photographs(look_at_source(folder), d);
  ASSERT_EQ(d.error_count(), 2);
  EXPECT_FINDING(d, "capture.photographs.few", "2 photographs");
  EXPECT_HAS(d.all()[1].text(), "b.png");
}

TEST(CapturePairs, OfAFilmCoverNeighboursAndLoops) {
  EXPECT_EQ(all_pairs(5).size(), 10u);
  const std::vector<Pair> pairs = pairs_in_order(400);
  const std::set<Pair> unique(pairs.begin(), pairs.end());
  EXPECT_EQ(unique.size(), pairs.size());
  for (const auto& [i, j] : pairs) ASSERT_TRUE(i < j && j < 400);
  for (std::size_t i = 0; i + 10 < 400; ++i) {
    for (std::size_t k = 1; k <= 10; ++k) ASSERT_TRUE(unique.contains({i, i + k}));
  }
  EXPECT_TRUE(unique.contains({0, 392})) << "the end meets the beginning";
  EXPECT_LT(pairs.size(), 8000u);
  EXPECT_EQ(pairs_in_order(8).size(), 28u);
}

TEST(CaptureLog, TheLatestNumberTells) {
  EXPECT_EQ(last_number_after("Processed file [3/9]\nProcessed file [12/35]", "Processed file ["), 12);
  EXPECT_EQ(last_number_after("Registering image #29 (35)\n  => ", " ("), 35);
  EXPECT_EQ(last_number_after("nothing", "Processed file ["), 0);
}

constexpr std::int32_t kSide = 32;
constexpr std::size_t kPixels = std::size_t{kSide} * kSide;

// A texture of the scene as seen at step t, blurred by a box of 2 r + 1 pixels.
std::vector<std::uint8_t> view(int t, int r = 0) {
  const RandomAddress texture{1, 0, stream_id("test/texture")};
  std::vector<std::uint8_t> out;
  for (int y = 0; y < kSide; ++y) {
    for (int x = 0; x < kSide; ++x) {
      double sum = 0;
      for (int dy = -r; dy <= r; ++dy) {
        for (int dx = -r; dx <= r; ++dx)
          sum += uniform01(texture, static_cast<std::uint64_t>((y + dy + 50) * 1000 + x + dx + 50 + 3 * t));
      }
      out.push_back(static_cast<std::uint8_t>(255 * sum / ((2 * r + 1) * (2 * r + 1))));
    }
  }
  return out;
}

TEST(CaptureSharpness, BlurTakesItAway) {
  const double sharp = sharpness(view(0), kSide);
  EXPECT_GT(sharp, 3 * sharpness(view(0, 1), kSide));
  EXPECT_GT(sharpness(view(0, 1), kSide), sharpness(view(0, 3), kSide));
  EXPECT_EQ(sharpness(std::vector<std::uint8_t>(kPixels, 7), kSide), 0);
  std::vector<std::uint8_t> dim = view(0);
  for (std::uint8_t& value : dim) value /= 2;
  EXPECT_NEAR(sharpness(dim, kSide), sharp, 0.01 * sharp) << "little light is no blur";
}

TEST(CaptureSharpness, TheSharpestOfEachIntervalUnlessStillOrBlurred) {
  std::vector<std::uint8_t> film;
  const auto add = [&](int t, int r) {
    const std::vector<std::uint8_t> one = view(t, r);
    film.insert(film.end(), one.begin(), one.end());
  };
  // Five intervals of three frames: the sharpest are 1, 4, 8; then one that shows the same as 8, then blur alone.
  for (const auto& [t, r] : {std::pair{0, 2},
                             {1, 0},
                             {2, 1},
                             {3, 1},
                             {4, 0},
                             {5, 2},
                             {6, 2},
                             {7, 1},
                             {8, 0},
                             {8, 1},
                             {8, 0},
                             {8, 2},
                             {12, 3},
                             {13, 3},
                             {14, 4}})
    add(t, r);
  const FrameChoice choice = choose_frames(film, kPixels, kSide, 5);
  EXPECT_EQ(choice.kept, (std::vector<std::size_t>{1, 4, 8}));
  EXPECT_EQ(choice.still, 1u);
  EXPECT_EQ(choice.blurred, 1u);
}

TEST(CaptureState, StepsAreRememberedForTheSamePhotographsAlone) {
  const std::string file = fresh_folder("s") + "/steps.json";
  {
    PrepareState state(file, "ten photographs");
    EXPECT_EQ(state.done("features"), nullptr);
    state.mark("features", "a\nb");
  }
  PrepareState again(file, "ten photographs");
  ASSERT_NE(again.done("features"), nullptr);
  EXPECT_EQ(*again.done("features"), "a\nb");
  EXPECT_ERROR(PrepareState(file, "eleven photographs"), "capture.scene.other", file);
  plain_write(file, "{\"identity\": \"ten ph");
  EXPECT_ERROR(PrepareState(file, "ten photographs"), "capture.scene.other", file);
}

TEST(CaptureMissing, RangesSayWhyAndWhatToDo) {
  const std::vector<std::string> names{"a", "b", "c", "d", "e", "f", "g"};
  Reconstruction found;
  found.best.images = {"a", "d"};
  found.others = {{.images = {"f", "g"}}};
  const std::vector<Missing> missing = missing_images(names, found, {"e"});
  ASSERT_EQ(missing.size(), 3u);
  EXPECT_EQ(missing[0].text,
            "photographs 2 to 3 (b to c) share too little with the others: take some between photographs 1 and 4");
  EXPECT_HAS(missing[1].text, "photograph 5 (e) is blurred: take it again");
  EXPECT_HAS(missing[2].text,
             "photographs 6 to 7 (f to g) fit others that are missing, but not the rest: take some "
             "between them and the others");
  found.misplaced = {"g"};
  EXPECT_HAS(missing_images(names, found, {"e"}).back().text, "photograph 7 (g) was placed far from", "left out");
  found.best.images = names;
  EXPECT_TRUE(missing_images(names, found, {}).empty());
}

// A walk of twelve photographs a step apart; each shares 40 points with the next and the one behind it.
ColmapModel walk_of(const std::vector<std::string>& names) {
  ColmapModel model;
  for (std::size_t i = 0; i < names.size(); ++i) {
    ColmapImage image;
    image.name = names[i];
    image.world_from_camera.t = {static_cast<double>(i), 0.1 * static_cast<double>(i % 3), 0};
    for (std::size_t p = 0; p < 120; ++p) image.points.push_back(static_cast<std::int64_t>(40 * i + p));
    model.images.push_back(image);
  }
  return model;
}
void put_elsewhere(ColmapModel& model, std::size_t image, double away) {
  model.images[image].world_from_camera.t.z = away;
  for (std::int64_t& point : model.images[image].points) point += 10'000;
}

TEST(CaptureMisplaced, AJumpThatSharesNothingWithItsNeighboursIsNamed) {
  const std::vector<std::string> names{"a", "b", "c", "d", "e", "f", "g", "h", "i", "j", "k", "l"};
  EXPECT_TRUE(misplaced_images(walk_of(names), names).empty());
  ColmapModel one = walk_of(names), back = one, three = one, near = one;
  put_elsewhere(one, 4, 20);
  EXPECT_EQ(misplaced_images(one, names), std::vector<std::string>{"e"});
  back.images[4].world_from_camera.t.z = 20;  // far away, but it sees what they see
  EXPECT_TRUE(misplaced_images(back, names).empty());
  put_elsewhere(near, 4, 0.5);  // it looks the other way from where they stand
  EXPECT_TRUE(misplaced_images(near, names).empty());
  for (ColmapImage& image : three.images) image.points.push_back(5);  // what all of them see
  for (const std::size_t i : {3, 4}) put_elsewhere(three, i, 30);
  for (std::size_t p = 0; p < 40; ++p) three.images[5].points.push_back(three.images[2].points[p]);
  EXPECT_EQ(misplaced_images(three, names), (std::vector<std::string>{"d", "e"}));
}

TEST(CaptureMisplaced, AJumpOfAnImageThatSeesLittleNeedsNoOtherSign) {
  const std::vector<std::string> names{"a", "b", "c", "d", "e", "f", "g", "h", "i", "j", "k", "l"};
  ColmapModel apart = walk_of(names);
  for (std::size_t i = 5; i < names.size(); ++i) {  // the halves of the walk share nothing
    for (std::int64_t& point : apart.images[i].points) point += 20'000;
  }
  ColmapModel held = apart;
  held.images[4].world_from_camera.t.z = 20;
  held.images[4].points.resize(40);
  EXPECT_TRUE(misplaced_images(held, names).empty()) << "it sees what the one before it sees";
  put_elsewhere(apart, 4, 20);
  EXPECT_TRUE(misplaced_images(apart, names).empty()) << "it may well stand there";
  apart.images[4].points.resize(40);
  EXPECT_EQ(misplaced_images(apart, names), std::vector<std::string>{"e"});
  put_elsewhere(apart, 4, 2);
  EXPECT_TRUE(misplaced_images(apart, names).empty());
}

TEST(CaptureMisplaced, ImagesThatLoseTheirPointsAreTorn) {
  const std::vector<std::string> names{"a", "b", "c"};
  const ColmapModel all = walk_of(names);
  ColmapModel kept = all;
  kept.images[0].points.resize(72);
  kept.images[1].points.resize(71);
  EXPECT_EQ(torn_images(all, kept), std::vector<std::string>{"b"});
  kept.images.pop_back();
  EXPECT_EQ(torn_images(all, kept), (std::vector<std::string>{"b", "c"}));
}

TEST(ColmapCameras, WrittenOnesReadBack) {
  const std::string folder = fresh_folder("m");
  write_room_model(folder, {0, 3}, 0.5);
  Camera lens = room_camera();
  lens.fy = 21;
  lens.k1 = 0.1;
  lens.k2 = -0.02;
  lens.p1 = 0.001;
  lens.p2 = -0.002;
  plain_write(folder + "/cameras.bin", colmap_cameras_file({{1, lens}}));
  Diagnostics d;
  const ColmapModel model = read_colmap_model(folder, d);
  EXPECT_FALSE(d.has_errors());
  EXPECT_EQ(model.error_px, 0.5);
  ASSERT_EQ(model.images.size(), 2u);
  EXPECT_LT(length(model.images[1].world_from_camera.t - room_pose(3).t), 1e-12);
  const Camera& read = model.cameras.at(1);
  for (const auto field :
       {&Camera::fx, &Camera::fy, &Camera::cx, &Camera::cy, &Camera::k1, &Camera::k2, &Camera::p1, &Camera::p2})
    EXPECT_EQ(read.*field, lens.*field);
  lens.lens = LensKind::fisheye;
  lens.k3 = 0.003;
  lens.k4 = -0.004;
  lens.p1 = lens.p2 = 0;
  plain_write(folder + "/cameras.bin", colmap_cameras_file({{1, lens}}));
  EXPECT_EQ(read_colmap_model(folder, d).cameras.at(1), lens);
}

}  // namespace
}  // namespace semfield

namespace semfield::testing_capture {

// A folder with photographs and with programs that stand for COLMAP and ffmpeg.

using namespace testing_room;
using namespace testing_program;
namespace fs = std::filesystem;

// Hands out models/ATTEMPT, counts its calls in `calls`, and does what files beside it say: fail_STEP, hang_STEP.
inline constexpr const char* kColmap = R"sh(#!/bin/sh
here=$(dirname "$0")
step=$1
echo "$*" >> "$here/calls"
if [ -e "$here/fail_$step" ]; then echo "before"; echo "E: the $step has no memory" >&2; exit 3; fi
if [ -e "$here/hang_$step" ]; then : > "$here/hangs"; exec sleep 100; fi
while [ $# -gt 0 ]; do
  case "$1" in
    --output_path) out=$2;;
    --input_path) in=$2;;
    --database_path) : > "$2";;
  esac
  shift
done
case "$step" in
  feature_extractor) echo "Processed file [6/6]";;
  mapper)
    n=$(grep -c '^mapper' "$here/calls")
    if [ -d "$here/models/$n" ]; then cp -r "$here/models/$n/." "$out"
    else echo "ERROR: failed to create sparse model"; exit 1; fi;;
  point_filtering) if [ -d "$here/filtered" ]; then in="$here/filtered"; fi; cp -r "$in/." "$out";;
  bundle_adjuster|image_deleter|image_registrator) cp -r "$in/." "$out";;
esac
)sh";
// The steps that follow a model.
inline const std::string kSettled =
    "point_filtering point_filtering bundle_adjuster point_filtering point_filtering bundle_adjuster point_filtering "
    "point_filtering bundle_adjuster point_filtering ";

// Eight seconds of film: small pictures of noise that changes, then the frames that are asked for. Of a panorama, one
// picture as each of its views.
inline constexpr const char* kFfmpeg = R"sh(#!/bin/sh
here=$(dirname "$0")
echo "ffmpeg $*" >> "$here/calls"
if [ -e "$here/fail_ffmpeg" ]; then echo "moov atom not found" >&2; exit 1; fi
for last; do
  case "$last" in */views/*_[0-9][0-9][0-9].jpg) cp "$here/frames/view.png" "$last";; esac
done
case "$last" in
  */views/*) ;;
  *.grey) cp "$here/film.grey" "$last";;
  *) i=0
     for image in "$here"/frames/*; do
       i=$((i+1))
       cp "$image" "$(dirname "$last")/00000$i.jpg"
     done;;
esac
)sh";
inline constexpr const char* kFfprobe = R"sh(#!/bin/sh
echo '{"streams": [{"codec_type": "video"}], "format": {"duration": "8.0"}}'
)sh";

class Prepare : public testing::Test {
 protected:
  void SetUp() override {
    home_ = fresh_folder("home");
    for (const char* folder : {"bin", "photographs"}) fs::create_directories(home_ + "/" + folder);
    tool("colmap", kColmap);
    for (int i = 0; i < 6; ++i) image(home_ + "/photographs/" + std::to_string(i) + ".png", i);
  }
  static void image(const std::string& path, int i) {
    write_png_rgb(path, 40, 30, render_room(room_camera(), room_pose(i)).rgb);
  }
  void tool(const std::string& name, const std::string& text) const {
    const std::string file = home_ + "/bin/" + name;
    plain_write(file, text);
    fs::permissions(file, fs::perms::owner_all);
  }
  std::string path_setting() const { return "PATH=" + home_ + "/bin:/usr/bin:/bin"; }
  Result prepare(const std::string& words = "photographs --out scene") const {
    return semfield_run("prepare " + words, home_, "PATH=" + shell_word(home_ + "/bin") + ":/usr/bin:/bin ");
  }
  void model(int attempt, int number, const std::vector<int>& images, double error_px = 0.5) const {
    write_room_model(home_ + "/bin/models/" + std::to_string(attempt) + "/" + std::to_string(number), images, error_px);
  }
  // First words of the calls so far, without the database.
  std::string steps() const {
    std::string out;
    const std::string calls = read_text_file(home_ + "/bin/calls");
    std::string_view rest = calls;
    for (std::string_view line; next_line(rest, line);) out += std::string(words_of(line)[0]) + " ";
    return out;
  }
  std::string home_;
};

}  // namespace semfield::testing_capture

namespace semfield {
namespace {

// `semfield prepare` with programs that stand for COLMAP and ffmpeg: order of steps, retries, failures, being ended.

using namespace testing_capture;

TEST_F(Prepare, AFolderOfPhotographsBecomesAScene) {
  model(1, 0, {0, 1, 2, 3, 4, 5});
  const Result r = succeeded(prepare());
  EXPECT_HAS(r.out, "registered  6 of 6 (100 %), reprojection error 0.50 pixels, 2 points, 1 attempt");
  EXPECT_HAS(r.err, "next        semfield init scene ");
  EXPECT_EQ(steps(), "feature_extractor matches_importer mapper " + kSettled);
  const std::string calls = read_text_file(home_ + "/bin/calls");
  EXPECT_HAS(calls, "--SiftExtraction.use_gpu 0", "--SiftMatching.use_gpu 0", "--ImageReader.single_camera 1");
  EXPECT_EQ(read_text_file(home_ + "/scene/images/3.png"), read_text_file(home_ + "/photographs/3.png"));
  EXPECT_EQ(semfield_run("inspect scene", home_).code, 0);
  EXPECT_FALSE(fs::exists(home_ + "/scene/prepare/work/quick.db")) << "nobody needs it any more";
  // A second call finds all done.
  EXPECT_EQ(prepare().code, 0);
  EXPECT_EQ(steps(), "feature_extractor matches_importer mapper " + kSettled);
}

TEST_F(Prepare, AnImageThatFitsFewOfItsPointsIsPlacedAnew) {
  const std::vector<int> all{0, 1, 2, 3, 4, 5};
  std::map<int, int> seen;
  for (const int i : all) seen[i] = 10;
  write_room_model(home_ + "/bin/models/1/0", all, 0.5, {}, seen);
  seen[4] = 5;
  write_room_model(home_ + "/bin/filtered", all, 0.5, {}, seen);
  EXPECT_EQ(prepare().code, 0);
  EXPECT_HAS(steps(), "mapper point_filtering image_deleter image_registrator point_filtering bundle_adjuster");
  EXPECT_EQ(read_text_file(home_ + "/scene/prepare/work/removed.txt"), "4.png\n");
  EXPECT_HAS(read_text_file(home_ + "/bin/calls"), "image_registrator --database_path", "quick.db",
             "point_filtering --max_reproj_error 1.5 ");
}

TEST_F(Prepare, TheLadderIsClimbedUntilEnoughHaveAPose) {
  model(1, 0, {0, 1, 2});
  model(2, 0, {0, 1});
  model(3, 0, {4, 5});
  model(3, 1, {0, 1, 2, 3}, 0.7);
  const Result r = succeeded(prepare("photographs --out scene --json"));
  const nlohmann::json told = nlohmann::json::parse(r.out);
  EXPECT_EQ(told["registered"], 4);
  EXPECT_EQ(told["attempts"], 4);
  ASSERT_EQ(told["missing"].size(), 1u);
  EXPECT_HAS(told["missing"][0].get<std::string>(), "photographs 5 to 6 (4.png to 5.png) fit others that are missing");
  EXPECT_EQ(steps(),
            "feature_extractor matches_importer mapper mapper feature_extractor matches_importer mapper "
            "feature_extractor matches_importer mapper " +
                kSettled);
  const std::string calls = read_text_file(home_ + "/bin/calls");
  EXPECT_HAS(calls, "--ImageReader.camera_model SIMPLE_RADIAL", "--ImageReader.camera_model OPENCV ",
             "--ImageReader.camera_model OPENCV_FISHEYE --ImageReader.default_focal_length_factor 0.4");
}

TEST_F(Prepare, AFisheyeIsTriedWhereNoOtherLensFits) {
  model(1, 0, {0, 1, 2, 3, 4, 5}, 1.3);
  model(2, 0, {0, 1, 2, 3, 4, 5}, 1.2);
  model(3, 0, {0, 1, 2, 3, 4, 5}, 0.5);
  const Result r = succeeded(prepare());
  EXPECT_HAS(r.err, "6 of 6 photographs have a pose, but the lens misses their points by 1.30 pixels; attempt 2");
  EXPECT_HAS(r.out, "registered  6 of 6 (100 %), reprojection error 0.50 pixels, 2 points, 3 attempts");
  EXPECT_EQ(steps(),
            "feature_extractor matches_importer mapper feature_extractor matches_importer mapper "
            "feature_extractor matches_importer mapper " +
                kSettled)
      << "asking less of images is no help where none are missing";
}

TEST_F(Prepare, AFisheyeIsTriedWhereALensBendsAsOneDoes) {
  Camera barrel = room_camera();
  barrel.k1 = -0.25 * std::pow(barrel.fx / barrel.cx, 2);
  for (int attempt = 1; attempt <= 3; ++attempt) {
    model(attempt, 0, {0, 1, 2, 3, 4, 5}, 0.3 + 0.1 * attempt);
    if (attempt < 3)
      plain_write(home_ + "/bin/models/" + std::to_string(attempt) + "/0/cameras.bin",
                  colmap_cameras_file({{1, barrel}}));
  }
  const Result r = succeeded(prepare());
  EXPECT_HAS(r.err, "6 of 6 photographs have a pose, but the lens bends borders as a fisheye does; attempt 2");
  EXPECT_HAS(r.out, "reprojection error 0.60 pixels, 2 points, 3 attempts") << "a lens that fits counts more";
}

TEST_F(Prepare, ALensThatFitsCountsMoreThanAnImage) {
  model(1, 0, {0, 1, 2, 3, 4, 5}, 1.3);
  model(2, 0, {0, 1, 2, 3, 4}, 0.5);
  model(3, 0, {0, 1, 2, 3}, 0.4);
  const Result r = succeeded(prepare());
  EXPECT_HAS(r.out, "registered  6 of 6 (100 %), reprojection error 1.30 pixels") << "five of six are not 95 %";
}

TEST_F(Prepare, AFisheyeThatIsAskedForIsTheFirstAttempt) {
  model(1, 0, {0, 1, 2, 3, 4, 5});
  const Result r = succeeded(prepare("photographs --out scene --lens fisheye"));
  EXPECT_HAS(r.out, "1 attempt");
  EXPECT_HAS(read_text_file(home_ + "/bin/calls"), "--ImageReader.camera_model OPENCV_FISHEYE");
  EXPECT_FALSE(fs::exists(home_ + "/scene/prepare/work/fisheye_quick.db"));
  EXPECT_SAID(prepare().err, "capture.scene.other", "other options");
}

TEST_F(Prepare, PanoramasBecomeEightViewsEach) {
  tool("ffmpeg", kFfmpeg);
  fs::create_directories(home_ + "/panoramas");
  for (int i = 0; i < 3; ++i) {
    const std::string name = std::to_string(i) + ".png";
    write_png_rgb(home_ + "/panoramas/" + name, 80, 40, std::vector<std::uint8_t>(std::size_t{80 * 40 * 3}, 90));
  }
  fs::create_directories(home_ + "/bin/frames");
  image(home_ + "/bin/frames/view.png", 0);
  std::vector<std::string> names;
  for (const char* turn : {"000", "045", "090", "135", "180", "225", "270", "315"})
    names.push_back("0_" + std::string(turn) + ".jpg");
  write_room_model(home_ + "/bin/models/1/0", {0, 1, 2, 3, 4, 5, 6, 7}, 0.5, names);
  const Result r = succeeded(prepare("panoramas --out scene --lens equirectangular --attempts 1"));
  EXPECT_HAS(r.out, "photographs 24 of 40 x 30 pixels", "registered  8 of 24 (33 %)");
  const std::string calls = read_text_file(home_ + "/bin/calls");
  EXPECT_HAS(calls, "v360=e:flat:yaw=0:h_fov=90:v_fov=90:w=20:h=20", "yaw=180:", "yaw=-45:",
             "--ImageReader.camera_model SIMPLE_PINHOLE --ImageReader.default_focal_length_factor 0.5");
  EXPECT_TRUE(fs::exists(home_ + "/scene/images/2_315.jpg"));
  EXPECT_FALSE(fs::exists(home_ + "/scene/prepare/work/panoramas"));
  const std::string before = steps();
  EXPECT_EQ(prepare("panoramas --out scene --lens equirectangular --attempts 1").code, 0);
  EXPECT_EQ(steps(), before) << "what is done is not done again";
}

TEST_F(Prepare, AnImageThatIsNoPanoramaIsRefused) {
  tool("ffmpeg", kFfmpeg);
  EXPECT_REFUSED(prepare("photographs --out scene --lens equirectangular"), 65, "capture.panoramas.shape", "0.png",
                 "40 x 30", "twice as wide as high");
}

TEST_F(Prepare, FewerAttemptsTakeWhatIsThere) {
  model(1, 0, {0, 1, 2});
  model(2, 0, {0, 1, 2, 3});
  const Result first = succeeded(prepare("photographs --out scene --attempts 2"));
  EXPECT_HAS(first.err, "3 of 6 photographs have a pose; attempt 2 takes longer", "--attempts 1");
  EXPECT_HAS(first.out, "registered  4 of 6 (67 %)", "2 attempts");
  const std::string done = steps();
  EXPECT_HAS(prepare().out, "registered  4 of 6 (67 %)", "2 attempts");
  EXPECT_EQ(steps(), done) << "what is published is not climbed on from";
}

TEST_F(Prepare, NoOverlapIsSaidWithARemedy) {
  EXPECT_REFUSED(prepare(), 65, "capture.poses.none", "no two of the 6 photographs", "4 attempts");
  EXPECT_FALSE(fs::exists(home_ + "/scene/sparse"));
}

TEST_F(Prepare, AFailedProgramIsQuotedAndTheNextCallGoesOn) {
  model(1, 0, {0, 1, 2, 3, 4, 5});
  plain_write(home_ + "/bin/fail_matches_importer", "");
  EXPECT_REFUSED(prepare(), 1, "capture.program.failed", "colmap matches_importer", "exit code 3",
                 "before | E: the matches_importer has no memory", home_ + "/scene/prepare/log/matches_quick.txt");
  EXPECT_FALSE(fs::exists(home_ + "/scene/sparse"));
  fs::remove(home_ + "/bin/fail_matches_importer");
  EXPECT_EQ(prepare().code, 0);
  EXPECT_EQ(steps(), "feature_extractor matches_importer matches_importer mapper " + kSettled);
}

TEST_F(Prepare, EndedInTheMiddleOfMatchingItGoesOn) {
  model(1, 0, {0, 1, 2, 3, 4, 5});
  for (const int signal : {SIGKILL, SIGTERM}) {
    SCOPED_TRACE(signal);
    fs::remove_all(home_ + "/scene");
    fs::remove(home_ + "/bin/calls");
    fs::remove(home_ + "/bin/hangs");
    plain_write(home_ + "/bin/hang_matches_importer", "");
    const std::string source = home_ + "/photographs", out = home_ + "/scene";
    Process process(program(), {"prepare", source, "--out", out}, home_, {path_setting()});
    for (int wait = 0; wait < 6000 && !fs::exists(home_ + "/bin/hangs"); ++wait)
      std::this_thread::sleep_for(std::chrono::milliseconds(10));
    ASSERT_TRUE(fs::exists(home_ + "/bin/hangs"));
    process.send(signal);
    const std::optional<Result> ended = process.wait_for(60);
    ASSERT_TRUE(ended.has_value());
    if (signal == SIGTERM) {
      EXPECT_EQ(ended->code, 143);
      EXPECT_HAS(ended->err, "stopped; the same command continues");
    }
    EXPECT_FALSE(fs::exists(out + "/sparse"));
    fs::remove(home_ + "/bin/hang_matches_importer");
    EXPECT_EQ(prepare().code, 0);
    EXPECT_EQ(steps(), "feature_extractor matches_importer matches_importer mapper " + kSettled);
  }
}

TEST_F(Prepare, AFolderOfOthersIsLeftAlone) {
  model(1, 0, {0, 1, 2, 3, 4, 5});
  fs::create_directories(home_ + "/scene");
  plain_write(home_ + "/scene/mine.txt", "");
  EXPECT_REFUSED(prepare(), 73, "files.output.exists", "scene");
  fs::remove_all(home_ + "/scene");
  EXPECT_EQ(prepare().code, 0);
  image(home_ + "/photographs/6.png", 6);
  EXPECT_REFUSED(prepare(), 73, "capture.scene.other", "scene");
}

TEST_F(Prepare, TheSourceIsNeverWrittenTo) {
  EXPECT_REFUSED(prepare("photographs --out photographs/scene"), 73, "capture.scene.inside", "photographs/scene");
  EXPECT_FALSE(fs::exists(home_ + "/photographs/scene"));
}

TEST_F(Prepare, AMissingProgramNamesTheCommandThatInstallsIt) {
  fs::remove(home_ + "/bin/colmap");
  EXPECT_REFUSED(semfield_run("prepare photographs --out scene", home_, "PATH=" + shell_word(home_ + "/bin") + " "), 69,
                 "capture.program.missing", "colmap", "sudo apt install colmap");
  EXPECT_FALSE(fs::exists(home_ + "/scene"));
}

TEST_F(Prepare, NamesThatColmapsListsCannotHold) {
  fs::rename(home_ + "/photographs/0.png", home_ + "/photographs/#my first.png");
  const Result r = prepare();
  EXPECT_EQ(r.code, 65) << "no model was laid out";
  EXPECT_TRUE(fs::exists(home_ + "/scene/images/_my_first.png"));
  EXPECT_TRUE(fs::exists(home_ + "/photographs/#my first.png"));
}

TEST_F(Prepare, MoreAttemptsGoOnFromFewer) {
  model(1, 0, {0, 1, 2});
  model(2, 0, {0, 1, 2, 3, 4});
  model(3, 0, {0, 1, 2, 3, 4, 5});
  EXPECT_HAS(prepare("photographs --out scene --attempts 1").out, "registered  3 of 6 (50 %)", "1 attempt");
  const Result more = succeeded(prepare("photographs --out scene --attempts 4"));
  EXPECT_HAS(more.out, "registered  6 of 6 (100 %)", "3 attempts");
  EXPECT_EQ(steps(), "feature_extractor matches_importer mapper " + kSettled +
                         "feature_extractor matches_importer mapper feature_extractor matches_importer mapper " +
                         kSettled)
      << "the first attempt's model is there; what it found in images is not";
  EXPECT_EQ(read_text_file(home_ + "/scene/sparse/0/images.bin"),
            read_text_file(home_ + "/scene/prepare/work/refined/images.bin"));
  EXPECT_HAS(semfield_run("inspect scene", home_).out, "6");
  const std::string done = steps();
  for (const char* attempts : {"", " --attempts 1", " --attempts 4"})
    EXPECT_HAS(prepare("photographs --out scene" + std::string(attempts)).out, "registered  6 of 6 (100 %)",
               "3 attempts");
  EXPECT_EQ(steps(), done) << "all have a pose";
}

TEST_F(Prepare, FoldersThatDifferInABlankAreTwoCameras) {
  fs::remove_all(home_ + "/photographs");
  for (const char* folder : {"cam 1", "cam_1", "cam_1_2"}) {
    fs::create_directories(home_ + "/photographs/" + folder);
    for (int i = 0; i < 2; ++i) image(home_ + "/photographs/" + folder + "/" + std::to_string(i) + ".png", i);
  }
  EXPECT_EQ(prepare().code, 65) << "no model was laid out";
  std::set<std::string> folders;
  for (const fs::directory_entry& entry : fs::recursive_directory_iterator(home_ + "/scene/images"))
    if (entry.is_regular_file()) folders.insert(entry.path().parent_path().filename().string());
  EXPECT_EQ(folders.size(), 3u);
  EXPECT_HAS(read_text_file(home_ + "/bin/calls"), "--ImageReader.single_camera_per_folder 1");
}

// `semfield prepare` of films and panoramas: what ffmpeg is given, with one that stands for it and with the true one.

TEST_F(Prepare, AVideoIsCutIntoItsSharpFrames) {
  tool("ffmpeg", kFfmpeg);
  tool("ffprobe", kFfprobe);
  // Twelve looks at six intervals of which the second half stands still.
  std::string film;
  for (int frame = 0; frame < 12; ++frame) {
    for (int p = 0; p < 256 * 256; ++p) film += static_cast<char>((p * 7919 + std::min(frame / 2, 3) * 31) % 251);
  }
  plain_write(home_ + "/bin/film.grey", film);
  plain_write(home_ + "/walk.mp4", "film");
  fs::create_directories(home_ + "/bin/frames");
  for (int i = 0; i < 4; ++i) image(home_ + "/bin/frames/" + std::to_string(i) + ".png", i);
  write_room_model(home_ + "/bin/models/1/0", {0, 1, 2, 3}, 0.5,
                   {"frame_000000.jpg", "frame_000002.jpg", "frame_000004.jpg", "frame_000006.jpg"});
  const Result r = succeeded(prepare("walk.mp4 --out scene --frames 6"));
  EXPECT_HAS(r.out, "video       4 frames of 8.0 s", "registered  4 of 4 (100 %)");
  const std::string calls = read_text_file(home_ + "/bin/calls");
  EXPECT_HAS(calls, "select=eq(n\\,0)+eq(n\\,2)+eq(n\\,4)+eq(n\\,6) ");
  const std::string steps = read_text_file(home_ + "/scene/prepare/steps.json");
  EXPECT_HAS(steps, "2 intervals were left out because nothing had moved, 0 because they were blurred");
  plain_write(home_ + "/bin/fail_ffmpeg", "");
  EXPECT_SAID(prepare("walk.mp4 --out other").err, "capture.program.failed", "ffmpeg", "moov atom not found");
}

// A film for the programs that stand for ffmpeg: two intervals of noise, and black ones.
class PrepareFilm : public Prepare {
 protected:
  void SetUp() override {
    Prepare::SetUp();
    tool("ffmpeg", kFfmpeg);
    tool("ffprobe", kFfprobe);
    plain_write(home_ + "/walk.mp4", "film");
    std::string film;
    for (std::size_t p = 0; p < std::size_t{12 * 256 * 256}; ++p)
      film += static_cast<char>((p * 7919 + p / 500000 * 31) % 251);
    plain_write(home_ + "/bin/film.grey", film);
    fs::create_directories(home_ + "/bin/frames");
    for (int i = 0; i < 3; ++i) image(home_ + "/bin/frames/" + std::to_string(i) + ".png", i);
  }
};

TEST_F(PrepareFilm, ManyFramesAreLookedAtWithoutHoldingThem) {
  fs::resize_file(home_ + "/bin/film.grey", std::size_t{600} * 8 * 256 * 256);  // 300 MiB, nearly all of it a hole
  EXPECT_REFUSED(prepare("walk.mp4 --out scene --frames 600"), 65, "capture.poses.none", "the 3 photographs");
  EXPECT_HAS(read_text_file(home_ + "/scene/prepare/steps.json"), "the sharpest of each of 600 intervals");
}

TEST_F(PrepareFilm, AFullDiskIsNoBadFilm) {
  tool("ffmpeg", "#!/bin/sh\necho 'av_interleaved_write_frame(): No space left on device' >&2\nexit 1\n");
  EXPECT_REFUSED(prepare("walk.mp4 --out scene"), 74, "files.write.failed", "ffmpeg", "No space left on device");
  tool("ffmpeg", "#!/bin/sh\nexit 0\n");  // as it ends where the last of a file did not find room
  EXPECT_REFUSED(semfield_run("prepare walk.mp4 --out scene", home_,
                              "ulimit -f 1000; PATH=" + shell_word(home_ + "/bin") + ":/usr/bin:/bin "),
                 74, "files.write.failed", "the limit of a file's size is reached");
}

// With the true ffmpeg, where it is installed.
class PrepareWithFfmpeg : public Prepare {
 protected:
  void SetUp() override {
    Prepare::SetUp();
    if (std::system("ffmpeg -version >/dev/null 2>&1 && ffprobe -version >/dev/null 2>&1") != 0)
      GTEST_SKIP() << "ffmpeg is not installed";
  }
  void film(const std::string& file) const {
    const std::string words =
        "ffmpeg -v error -f lavfi -i color=gray:size=64x48:rate=12:duration=3,noise=alls=100:allf=t -pix_fmt yuv420p ";
    ASSERT_EQ(std::system((words + shell_word(file)).c_str()), 0);
  }
  // Files below a folder, by their paths in it.
  static std::set<std::string> files_below(const std::string& folder) {
    std::set<std::string> out;
    for (const fs::directory_entry& entry : fs::recursive_directory_iterator(folder))
      if (entry.is_regular_file()) out.insert(fs::relative(entry.path(), folder).string());
    return out;
  }
};

TEST_F(PrepareWithFfmpeg, APercentSignIsAPartOfAName) {
  for (const std::string name : {"50%off", "a%06d", "%%", "%d", "%5"}) {
    SCOPED_TRACE(name);
    const std::string folder = home_ + "/" + name;
    fs::create_directories(folder);
    film(folder + "/" + name + ".mp4");
    const std::set<std::string> before = files_below(home_);
    const Result r =
        prepare(shell_word(name + "/" + name + ".mp4") + " --out " + shell_word(name + "/scene") + " --frames 6");
    EXPECT_EQ(r.code, 65) << r.err;  // no model was laid out
    EXPECT_SAID(r.err, "capture.poses.none");
    std::size_t images = 0;
    for (const std::string& file : files_below(home_)) {
      if (before.contains(file) || file == "bin/calls" || file == "stdout" || file == "stderr") continue;
      EXPECT_TRUE(file.starts_with(name + "/scene/")) << file << " lies outside the scene";
      images += file.starts_with(name + "/scene/images/frame_") ? 1 : 0;
    }
    EXPECT_EQ(images, 6u);
  }
}

TEST_F(PrepareWithFfmpeg, APercentSignIsAPartOfAPanoramasName) {
  const std::string folder = home_ + "/50%off %02d";
  fs::create_directories(folder);
  for (int i = 0; i < 3; ++i) {
    std::vector<std::uint8_t> grey(std::size_t{80 * 40 * 3}, static_cast<std::uint8_t>(60 * i + 40));
    write_png_rgb(folder + "/p%02d_" + std::to_string(i) + ".png", 80, 40, grey);
    write_png_rgb(folder + "/p0" + std::to_string(i) + "_0.png", 80, 40, std::vector<std::uint8_t>(grey.size(), 5));
  }
  EXPECT_REFUSED(prepare(shell_word("50%off %02d") + " --out " + shell_word("s%03d") + " --lens equirectangular"), 65,
                 "capture.poses.none");
  EXPECT_EQ(files_below(home_ + "/s%03d/images").size(), 48u);
  for (int i = 0; i < 3; ++i) {
    const auto view = read_rgb(home_ + "/s%03d/images/p%02d_" + std::to_string(i) + "_090.jpg");
    EXPECT_NEAR(view.pixels[0], 60 * i + 40, 3) << "another image was cut";
  }
}

TEST_F(PrepareWithFfmpeg, APlaylistIsNoFilm) {
  film(home_ + "/secret.mp4");
  const std::string line = "file '" + home_ + "/secret.mp4'\n";
  const std::map<std::string, std::string> lists{
      {"concat.mp4", "ffconcat version 1.0\n" + line},
      {"list.mov", "#EXTM3U\n#EXT-X-TARGETDURATION:3\n#EXTINF:3,\n" + home_ + "/secret.mp4\n#EXT-X-ENDLIST\n"}};
  for (const auto& [name, text] : lists) {
    SCOPED_TRACE(name);
    plain_write(home_ + "/" + name, text);
    EXPECT_REFUSED(prepare(name + " --out scene_of_" + name + " --frames 6"), 65, "capture.video.format", name);
    EXPECT_FALSE(fs::exists(home_ + "/scene_of_" + name + "/images"));
  }
}

}  // namespace
}  // namespace semfield
