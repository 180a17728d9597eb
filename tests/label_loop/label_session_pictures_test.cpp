// Pictures that a labelling session makes between its steps: of views, of free cameras, for several who look.
#include <gtest/gtest.h>

#include <atomic>
#include <chrono>
#include <cstdint>
#include <cstdlib>
#include <future>
#include <string>
#include <thread>
#include <vector>

#include "tests/label_loop/running_session.h"

namespace semfield {
namespace {

using namespace testing_loop;
using testing_train::TempDir;

PictureRequest of_camera(const FreeCamera& camera, const std::string& client) {
  PictureRequest request;
  request.client = client;
  request.camera = camera;
  request.most_px = 48;
  request.color = true;
  return request;
}

TEST(LabelSessionPictures, ViewsAndFreeCamerasAreDrawnWhileItTrains) {
  const TempDir dir;
  RunningSession run(session_config(), dir / "run");
  run.session.apply(run.add("1", "wall"));
  run.session.apply(run.click("2", 0, "wall", {24.5, 5.5}));
  run.start();
  const std::uint64_t overlay = run.settled()->overlay_revision;
  PictureRequest view;
  view.client = "a";
  view.view = 3;
  view.entropy = true;
  const Picture labels = run.session.picture(view);
  EXPECT_FALSE(labels.stale);
  EXPECT_EQ(labels.label.size(), 48u * 36u);
  EXPECT_EQ(labels.entropy.size(), labels.label.size());
  EXPECT_TRUE(labels.rgb.empty());
  EXPECT_GE(labels.overlay_revision, overlay);
  const Picture seen = run.session.picture(of_camera(run.session.camera_of(3), "a"));
  EXPECT_EQ(seen.width_px, 48);
  EXPECT_EQ(seen.height_px, 36);
  EXPECT_EQ(seen.rgb.size(), 3u * 48 * 36);
  EXPECT_EQ(seen.label.size(), 48u * 36u);
  // The camera of a view sees what its photograph shows.
  const StoredFrame& photo = run.session.opened().scene.frames[static_cast<std::size_t>(run.session.frame_of(3))];
  double wrong = 0;
  for (std::size_t i = 0; i < seen.rgb.size(); ++i) wrong += std::abs(int{seen.rgb[i]} - int{photo.rgb[i]});
  EXPECT_LT(wrong / static_cast<double>(seen.rgb.size()), 40);
  view.color = view.full = true;
  EXPECT_EQ(run.session.picture(view).rgb.size(), 3u * 48 * 36);
}

TEST(LabelSessionPictures, ALaterRequestOfTheSameClientTakesThePlace) {
  const TempDir dir;
  RunningSession run(session_config(), dir / "run");
  const FreeCamera camera = run.session.camera_of(0);
  const auto ask = [&](const std::string& client) {
    return std::async(std::launch::async,
                      [&run, camera, client] { return run.session.picture(of_camera(camera, client)); });
  };
  // Nobody trains yet, so both wait: the earlier one is answered when the later one comes.
  std::future<Picture> one = ask("a"), two = ask("a"), other = ask("b");
  bool one_first = false, answered = false;
  for (int turn = 0; !answered && turn < 2000; ++turn) {
    one_first = one.wait_for(std::chrono::milliseconds(5)) == std::future_status::ready;
    answered = one_first || two.wait_for(std::chrono::milliseconds(5)) == std::future_status::ready;
  }
  if (!answered) run.start();  // nothing would be answered ever
  ASSERT_TRUE(answered);
  const Picture stale = (one_first ? one : two).get();
  EXPECT_TRUE(stale.stale);
  EXPECT_TRUE(stale.rgb.empty());
  run.start();
  const Picture made = (one_first ? two : one).get();
  EXPECT_FALSE(made.stale);
  EXPECT_FALSE(made.rgb.empty());
  EXPECT_FALSE(other.get().stale) << "another client's has nothing to do with it";
}

// Nobody trains in these two, so whoever is answered did not wait for a picture.
TEST(LabelSessionPictures, OneThatNobodyWantsAnyMoreIsGivenUp) {
  const TempDir dir;
  RunningSession run(session_config(), dir / "run");
  std::atomic<int> looks{0};
  const Picture none = run.session.picture(of_camera(run.session.camera_of(0), "a"), [&] { return ++looks == 3; });
  EXPECT_TRUE(none.stale);
  EXPECT_EQ(looks, 3);
}

TEST(LabelSessionPictures, OfTooManyThatWaitTheOldestIsStale) {
  const TempDir dir;
  RunningSession run(session_config(), dir / "run");
  std::vector<std::future<Picture>> waiting;
  std::atomic<int> answered{0};
  for (int k = 0; k < 40; ++k)
    waiting.push_back(std::async(std::launch::async, [&, k] {
      const Picture picture = run.session.picture(of_camera(run.session.camera_of(0), "c" + std::to_string(k)));
      ++answered;
      return picture;
    }));
  for (int turn = 0; answered < 24 && turn < 2000; ++turn) std::this_thread::sleep_for(std::chrono::milliseconds(10));
  EXPECT_EQ(answered, 24) << "16 wait";
  run.session.stop();
  run.start();
  for (std::future<Picture>& picture : waiting) EXPECT_TRUE(picture.get().stale);
}

TEST(LabelSessionPictures, WrongRequestsAreRefusedAndTheSessionGoesOn) {
  const TempDir dir;
  RunningSession run(session_config(), dir / "run");
  run.start();
  const auto refusal = [&](const PictureRequest& request) {
    try {
      run.session.picture(request);
    } catch (const Error& error) {
      return std::string(error.what());
    }
    return std::string();
  };
  PictureRequest nothing;
  nothing.client = "a";
  EXPECT_NE(refusal(nothing).find("picture: "), std::string::npos);
  PictureRequest far = nothing;
  far.view = 1000;
  EXPECT_NE(refusal(far).find("view 1000 is none of the 12"), std::string::npos);
  PictureRequest large = of_camera(run.session.camera_of(0), "a");
  large.most_px = 100000;
  EXPECT_NE(refusal(large).find("most_px 100000"), std::string::npos);
  EXPECT_FALSE(run.session.picture(of_camera(run.session.camera_of(0), "a")).stale);
  EXPECT_TRUE(run.session.state()->failure.empty());
}

TEST(LabelSessionPictures, AfterTheEndTheyAreStale) {
  const TempDir dir;
  RunningSession run(session_config(), dir / "run");
  std::future<Picture> waits =
      std::async(std::launch::async, [&] { return run.session.picture(of_camera(run.session.camera_of(0), "a")); });
  run.session.stop();
  run.start();
  EXPECT_TRUE(waits.get().stale);
  run.stop();
  EXPECT_TRUE(run.session.picture(of_camera(run.session.camera_of(0), "b")).stale);
  EXPECT_EQ(run.ended_with, "");
}

}  // namespace
}  // namespace semfield
