// Pictures of views and of free cameras, made in pieces: their sizes, what they show, and requests that are refused.
#include "serve/view_pictures.h"

#include "core/error.h"
#include "tests/label_loop/looped_room.h"

namespace semfield {
namespace {

using namespace testing_loop;

struct PicturedRoom : LoopedRoom {
  PicturedRoom() : LoopedRoom(60) {}

  ViewPictures pictures{*training, *loop};

  FreeCamera camera() const { return {loop->views()[1].camera.world_from_camera, 60}; }
  Picture made(const PictureRequest& request, double budget_s = 1e9) {
    pictures.begin(request);
    std::optional<Picture> picture;
    for (int turn = 0; !picture && turn < 1000; ++turn) picture = pictures.work(budget_s);
    EXPECT_TRUE(picture.has_value());
    return picture ? std::move(*picture) : Picture();
  }
  std::string refusal(const PictureRequest& request) {
    return error_of(ErrorKind::usage, [&] { pictures.begin(request); });
  }
};

PictureRequest of_view(int view) { return PictureRequest{.view = view}; }

PictureRequest of_camera(const FreeCamera& camera, std::int32_t most_px = 0) {
  return PictureRequest{.camera = camera, .most_px = most_px, .color = true, .entropy = true, .full = true};
}

void expect_whole(const Picture& picture, bool rgb, bool label, bool entropy) {
  const auto pixels = static_cast<std::size_t>(picture.width_px * picture.height_px);
  EXPECT_GT(pixels, 0u);
  EXPECT_EQ(picture.rgb.size(), rgb ? 3 * pixels : 0);
  EXPECT_EQ(picture.label.size(), label ? pixels : 0);
  EXPECT_EQ(picture.entropy.size(), entropy ? pixels : 0);
}

void expect_none(const Picture& picture) {
  EXPECT_TRUE(picture.rgb.empty() && picture.label.empty() && picture.entropy.empty());
}

TEST(ViewPictures, AViewsLabelsAreThoseOfTheLoop) {
  PicturedRoom room;
  EXPECT_EQ(room.made(of_view(2)).label, std::vector<std::int16_t>(48 * 36, kVoid)) << "nothing is learned";
  room.loop->learn(room.clicks(8));
  PictureRequest request = of_view(2);
  request.entropy = true;
  const Picture coarse = room.made(request);
  EXPECT_EQ(coarse.width_px, 48);
  EXPECT_EQ(coarse.height_px, 36);
  expect_whole(coarse, false, true, true);
  EXPECT_EQ(coarse.label, room.loop->labels_of(2).label);
  EXPECT_EQ(coarse.entropy, room.loop->labels_of(2).entropy);
  while (!room.pictures.refine(0.001)) {
  }
  const SurfaceMap fine = room.loop->map_of(2, 1);
  EXPECT_EQ(room.made(request).label, room.loop->labels_of(2, &fine).label) << "its own surface is finer";
  EXPECT_FALSE(room.pictures.refine(1)) << "it is complete";
  request.labels = false;
  expect_whole(room.made(request), false, false, true);
}

TEST(ViewPictures, AFreeCameraIsRenderedInPieces) {
  PicturedRoom room;
  room.loop->learn(room.clicks(8));
  const Picture whole = room.made(of_camera(room.camera()));
  EXPECT_EQ(whole.width_px, 48);
  EXPECT_EQ(whole.height_px, 36);
  expect_whole(whole, true, true, true);
  const Picture pieces = room.made(of_camera(room.camera()), 0);
  EXPECT_EQ(pieces.rgb, whole.rgb);
  EXPECT_EQ(pieces.label, whole.label);
  EXPECT_EQ(pieces.entropy, whole.entropy);
  const auto named = std::count_if(whole.label.begin(), whole.label.end(), [](std::int16_t l) { return l >= 0; });
  EXPECT_GT(named, 48 * 36 / 2);
  PictureRequest request = of_view(1);  // the same camera, but with its own focal length
  request.color = request.full = true;
  expect_whole(room.made(request), true, true, false);
}

TEST(ViewPictures, ClicksOfOtherViewsAreShownWhereTheyAreSeen) {
  PicturedRoom room;
  room.loop->learn(room.clicks(8));
  const std::vector<Annotations::Mark> marks{{"own", room.loop->views()[1].frame, {{24.5, 18.5}}, 0, 0},
                                             {"other", room.loop->views()[2].frame, {{24.5, 18.5}}, 0, 0}};
  std::vector<int> view_of_frame(room.training->session().scene.frames.size(), -1);
  for (int v = 0; v < std::ssize(room.loop->views()); ++v) view_of_frame[room.loop->views()[v].frame] = v;
  room.pictures.set_marks(marks, view_of_frame);
  const auto ids = [](const Picture& picture) {
    std::string out;
    for (const SeenMark& mark : picture.seen) out += mark.id + " ";
    return out;
  };
  EXPECT_LACKS(ids(room.made(of_view(2))), "other") << "a view's own clicks are in the state";
  EXPECT_LACKS(ids(room.made(of_view(1))), "own");
  PictureRequest same = of_camera({room.loop->views()[2].camera.world_from_camera, 60});
  const RayCamera& camera = room.loop->views()[2].camera;
  same.camera->fov_deg = 2 * std::atan(camera.camera.width_px / (2 * camera.camera.fx)) * 57.29577951308232;
  same.labels = true;
  const Picture flown = room.made(same);
  const auto other =
      std::find_if(flown.seen.begin(), flown.seen.end(), [](const SeenMark& mark) { return mark.id == "other"; });
  ASSERT_NE(other, flown.seen.end()) << "a free camera that looks as view 2 does";
  EXPECT_NEAR(other->points[0].x, 24.5 * flown.width_px / 48, 1);
  EXPECT_NEAR(other->points[0].y, 18.5 * flown.height_px / 36, 1);
}

TEST(ViewPictures, APointOfAFreeCameraIsFoundInAPhotograph) {
  PicturedRoom room;
  PictureRequest request{.camera = room.camera(), .at = PixelPoint{0.5, 0.5}, .labels = false};
  const Picture answer = room.made(request);
  expect_none(answer);
  EXPECT_TRUE(answer.meets_surface);
  EXPECT_EQ(answer.nearest_view, 1) << "the camera stands where view 1 was taken";
  ASSERT_TRUE(answer.spot.has_value());
  const RayCamera& seen = room.loop->views()[answer.spot->view].camera;
  const PixelPlace there{static_cast<std::int32_t>(answer.spot->at.x), static_cast<std::int32_t>(answer.spot->at.y)};
  const Vec3d middle = hit_at(room.loop->views()[1].camera, {24, 18}).point;
  EXPECT_LT(length(hit_at(seen, there).point - middle), 0.5);
  request.camera->world_from_camera.t = {1e6, -1e6, 1e6};
  const Picture nothing = room.made(request);
  EXPECT_FALSE(nothing.meets_surface);
  EXPECT_FALSE(nothing.spot.has_value());
  EXPECT_GE(nothing.nearest_view, 0);
}

TEST(ViewPictures, BoundsOfEveryNumberAreTaken) {
  PicturedRoom room;
  room.loop->learn(room.clicks(8));
  for (const double fov : {1.0, 170.0}) {
    FreeCamera camera = room.camera();
    camera.fov_deg = fov;
    const Picture picture = room.made(of_camera(camera, 48));
    EXPECT_EQ(picture.width_px, 48);
    EXPECT_EQ(picture.height_px, 36);
    expect_whole(picture, true, true, true);
  }
  PictureRequest moving = of_camera(room.camera(), 4096);
  moving.full = false;
  const Picture quick = room.made(moving);  // a camera that moves gets what can be had at once
  EXPECT_LT(quick.width_px, 4096);
  EXPECT_GE(quick.width_px, 48);
  expect_whole(quick, true, true, true);
  FreeCamera away = room.camera();  // far outside the room: there is nothing to see, and no error
  away.world_from_camera.t = {1e6, -1e6, 1e6};
  const Picture nothing = room.made(of_camera(away, 64));
  expect_whole(nothing, true, true, true);
  EXPECT_EQ(nothing.label, std::vector<std::int16_t>(nothing.label.size(), kVoid));
}

TEST(ViewPictures, WrongRequestsAreRefusedWithASentence) {
  PicturedRoom room;
  const int views = static_cast<int>(room.loop->views().size());
  EXPECT_HAS(room.refusal(of_view(views)), "view 9 is none of the 9");
  EXPECT_HAS(room.refusal(of_view(-1)), "neither a view nor a camera");
  PictureRequest both = of_camera(room.camera());
  both.view = 2;
  EXPECT_HAS(room.refusal(both), "both a view and a camera");
  for (const std::int32_t side : {-1, 1, 47, 4097, std::numeric_limits<std::int32_t>::max()})
    EXPECT_HAS(room.refusal(of_camera(room.camera(), side)), "most_px");
  for (const double fov : {0.0, 0.5, 171.0, std::nan("")}) {
    FreeCamera camera = room.camera();
    camera.fov_deg = fov;
    EXPECT_HAS(room.refusal(of_camera(camera)), "field of view");
  }
  for (const double bad : {std::nan(""), HUGE_VAL}) {
    FreeCamera camera = room.camera();
    camera.world_from_camera.t.y = bad;
    EXPECT_HAS(room.refusal(of_camera(camera)), "not finite");
    camera = room.camera();
    camera.world_from_camera.r[1][2] = bad;
    EXPECT_HAS(room.refusal(of_camera(camera)), "not finite");
  }
  EXPECT_FALSE(room.pictures.work(1).has_value()) << "nothing is under way";
}

// The first click, or the last undo, may come while rows of a picture are made.
TEST(ViewPictures, APictureIsWholeWhateverIsLearnedMeanwhile) {
  PicturedRoom room;
  for (const bool click : {true, false}) {
    PictureRequest request = of_camera(room.camera(), 4096);
    request.camera->fov_deg = 100;
    request.most_px = 96;
    room.pictures.begin(request);
    ASSERT_FALSE(room.pictures.work(0).has_value()) << "some rows are left";
    room.loop->learn(click ? room.clicks(6) : std::vector<LabelledPixels>());
    std::optional<Picture> picture;
    while (!picture) picture = room.pictures.work(1e9);
    const auto pixels = static_cast<std::size_t>(picture->width_px * picture->height_px);
    EXPECT_EQ(picture->rgb.size(), 3 * pixels);
    EXPECT_TRUE(picture->label.empty() || picture->label.size() == pixels) << picture->label.size();
    EXPECT_TRUE(picture->entropy.empty() || picture->entropy.size() == pixels) << picture->entropy.size();
  }
}

}  // namespace
}  // namespace semfield
