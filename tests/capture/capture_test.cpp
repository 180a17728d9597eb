#include <algorithm>
#include <cstdint>
#include <set>
#include <string>
#include <vector>

#include "core/rng.h"
#include "scene/camera.h"
#include "scene/loading/capture/photographs.h"
#include "scene/loading/capture/prepare.h"
#include "scene/loading/colmap_model.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

// The parts of capture: names and their order, photographs that do not belong together, pairs, sharp frames, what is
// said of photographs without a pose.

using namespace testing_room;

TEST(CaptureNames, NumbersInNamesAreNumbers) {
  std::vector<std::string> names{"b2.jpg", "10.jpg", "b10.jpg", "2.jpg", "02.jpg", "b.jpg", "2"};
  std::sort(names.begin(), names.end(), comes_before);
  EXPECT_EQ(names, (std::vector<std::string>{"2", "02.jpg", "2.jpg", "10.jpg", "b.jpg", "b2.jpg", "b10.jpg"}));
  for (const std::string& a : names) EXPECT_FALSE(comes_before(a, a));
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
  const int place[15] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 8, 8, 8, 12, 13, 14};
  const int blur[15] = {2, 0, 1, 1, 0, 2, 2, 1, 0, 1, 0, 2, 3, 3, 4};
  for (std::size_t i = 0; i < 15; ++i) add(place[i], blur[i]);
  const FrameChoice choice = choose_frames(film, kPixels, kSide, 5);
  EXPECT_EQ(choice.kept, (std::vector<std::size_t>{1, 4, 8}));
  EXPECT_EQ(choice.still, 1u);
  EXPECT_EQ(choice.blurred, 1u);
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
  std::string images, points;
  const auto put = [](std::string& out, auto value) {
    out.append(reinterpret_cast<const char*>(&value), sizeof value);
  };
  put(images, std::uint64_t{2});
  for (const std::uint32_t i : {0u, 3u}) {
    const Pose pose = room_pose(static_cast<int>(i));
    const Quaternion q = quaternion_of(pose);
    const Vec3d t = pose.unrotate(pose.t) * -1.0;
    put(images, i);
    for (const double v : {q[0], -q[1], -q[2], -q[3], t.x, t.y, t.z}) put(images, v);
    put(images, std::uint32_t{1});
    images += std::to_string(i) + ".png" + '\0';
    put(images, std::uint64_t{0});
  }
  put(points, std::uint64_t{2});
  for (const double error_px : {0.25, 0.75}) {
    put(points, static_cast<std::uint64_t>(4 * error_px));
    for (const double v : {1.0, 0.5, error_px}) put(points, v);
    points += "rgb";
    put(points, error_px);
    put(points, std::uint64_t{0});
  }
  plain_write(folder + "/images.bin", images);
  plain_write(folder + "/points3D.bin", points);
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
