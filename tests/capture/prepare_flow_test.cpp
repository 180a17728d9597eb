// `semfield prepare` with programs that stand for COLMAP and ffmpeg: order of steps, retries, failures, being ended.
#include <nlohmann/json.hpp>
#include <set>

#include "tests/capture/prepare_case.h"

namespace semfield {
namespace {

using namespace testing_capture;

TEST_F(Prepare, AFolderOfPhotographsBecomesAScene) {
  model(1, 0, {0, 1, 2, 3, 4, 5});
  const Result r = prepare();
  EXPECT_EQ(r.code, 0) << r.err;
  EXPECT_HAS(r.out, "registered  6 of 6 (100 %), reprojection error 0.50 pixels, 2 points, 1 attempt");
  EXPECT_HAS(r.err, "next        semfield init scene ");
  EXPECT_EQ(steps(), "feature_extractor matches_importer mapper " + kSettled);
  const std::string calls = read_text_file(home_ + "/bin/calls");
  EXPECT_HAS(calls, "--SiftExtraction.use_gpu 0");
  EXPECT_HAS(calls, "--SiftMatching.use_gpu 0");
  EXPECT_HAS(calls, "--ImageReader.single_camera 1");
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
  const Result r = prepare("photographs --out scene --json");
  EXPECT_EQ(r.code, 0) << r.err;
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
  EXPECT_HAS(calls, "--ImageReader.camera_model SIMPLE_RADIAL");
  EXPECT_HAS(calls, "--ImageReader.camera_model OPENCV ");
  EXPECT_HAS(calls, "--ImageReader.camera_model OPENCV_FISHEYE --ImageReader.default_focal_length_factor 0.4");
}

TEST_F(Prepare, AFisheyeIsTriedWhereNoOtherLensFits) {
  model(1, 0, {0, 1, 2, 3, 4, 5}, 1.3);
  model(2, 0, {0, 1, 2, 3, 4, 5}, 1.2);
  model(3, 0, {0, 1, 2, 3, 4, 5}, 0.5);
  const Result r = prepare();
  EXPECT_EQ(r.code, 0) << r.err;
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
  const Result r = prepare();
  EXPECT_EQ(r.code, 0) << r.err;
  EXPECT_HAS(r.err, "6 of 6 photographs have a pose, but the lens bends borders as a fisheye does; attempt 2");
  EXPECT_HAS(r.out, "reprojection error 0.60 pixels, 2 points, 3 attempts") << "a lens that fits counts more";
}

TEST_F(Prepare, ALensThatFitsCountsMoreThanAnImage) {
  model(1, 0, {0, 1, 2, 3, 4, 5}, 1.3);
  model(2, 0, {0, 1, 2, 3, 4}, 0.5);
  model(3, 0, {0, 1, 2, 3}, 0.4);
  const Result r = prepare();
  EXPECT_EQ(r.code, 0) << r.err;
  EXPECT_HAS(r.out, "registered  6 of 6 (100 %), reprojection error 1.30 pixels") << "five of six are not 95 %";
}

TEST_F(Prepare, AFisheyeThatIsAskedForIsTheFirstAttempt) {
  model(1, 0, {0, 1, 2, 3, 4, 5});
  const Result r = prepare("photographs --out scene --lens fisheye");
  EXPECT_EQ(r.code, 0) << r.err;
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
  const Result r = prepare("panoramas --out scene --lens equirectangular --attempts 1");
  EXPECT_EQ(r.code, 0) << r.err;
  EXPECT_HAS(r.out, "photographs 24 of 40 x 30 pixels", "registered  8 of 24 (33 %)");
  const std::string calls = read_text_file(home_ + "/bin/calls");
  EXPECT_HAS(calls, "v360=e:flat:yaw=0:h_fov=90:v_fov=90:w=20:h=20", "yaw=180:", "yaw=-45:");
  EXPECT_HAS(calls, "--ImageReader.camera_model SIMPLE_PINHOLE --ImageReader.default_focal_length_factor 0.5");
  EXPECT_TRUE(fs::exists(home_ + "/scene/images/2_315.jpg"));
  EXPECT_FALSE(fs::exists(home_ + "/scene/prepare/work/panoramas"));
  const std::string before = steps();
  EXPECT_EQ(prepare("panoramas --out scene --lens equirectangular --attempts 1").code, 0);
  EXPECT_EQ(steps(), before) << "what is done is not done again";
}

TEST_F(Prepare, AnImageThatIsNoPanoramaIsRefused) {
  tool("ffmpeg", kFfmpeg);
  const Result r = prepare("photographs --out scene --lens equirectangular");
  EXPECT_EQ(r.code, 65);
  EXPECT_SAID(r.err, "capture.panoramas.shape", "0.png", "40 x 30", "twice as wide as high");
}

TEST_F(Prepare, FewerAttemptsTakeWhatIsThere) {
  model(1, 0, {0, 1, 2});
  model(2, 0, {0, 1, 2, 3});
  const Result first = prepare("photographs --out scene --attempts 2");
  EXPECT_EQ(first.code, 0) << first.err;
  EXPECT_HAS(first.err, "3 of 6 photographs have a pose; attempt 2 takes longer", "--attempts 1");
  EXPECT_HAS(first.out, "registered  4 of 6 (67 %)", "2 attempts");
  const std::string done = steps();
  EXPECT_HAS(prepare().out, "registered  4 of 6 (67 %)", "2 attempts");
  EXPECT_EQ(steps(), done) << "what is published is not climbed on from";
}

TEST_F(Prepare, NoOverlapIsSaidWithARemedy) {
  const Result r = prepare();
  EXPECT_EQ(r.code, 65);
  EXPECT_SAID(r.err, "capture.poses.none", "no two of the 6 photographs", "4 attempts");
  EXPECT_FALSE(fs::exists(home_ + "/scene/sparse"));
}

TEST_F(Prepare, AFailedProgramIsQuotedAndTheNextCallGoesOn) {
  model(1, 0, {0, 1, 2, 3, 4, 5});
  plain_write(home_ + "/bin/fail_matches_importer", "");
  const Result r = prepare();
  EXPECT_EQ(r.code, 1);
  EXPECT_SAID(r.err, "capture.program.failed", "colmap matches_importer", "exit code 3",
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
  const Result taken = prepare();
  EXPECT_EQ(taken.code, 73);
  EXPECT_SAID(taken.err, "files.output.exists", "scene");
  fs::remove_all(home_ + "/scene");
  EXPECT_EQ(prepare().code, 0);
  image(home_ + "/photographs/6.png", 6);
  const Result other = prepare();
  EXPECT_EQ(other.code, 73);
  EXPECT_SAID(other.err, "capture.scene.other", "scene");
}

TEST_F(Prepare, TheSourceIsNeverWrittenTo) {
  const Result r = prepare("photographs --out photographs/scene");
  EXPECT_EQ(r.code, 73);
  EXPECT_SAID(r.err, "capture.scene.inside", "photographs/scene");
  EXPECT_FALSE(fs::exists(home_ + "/photographs/scene"));
}

TEST_F(Prepare, AMissingProgramNamesTheCommandThatInstallsIt) {
  fs::remove(home_ + "/bin/colmap");
  const Result r = semfield_run("prepare photographs --out scene", home_, "PATH=" + shell_word(home_ + "/bin") + " ");
  EXPECT_EQ(r.code, 69);
  EXPECT_SAID(r.err, "capture.program.missing", "colmap", "sudo apt install colmap");
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
  const Result more = prepare("photographs --out scene --attempts 4");
  EXPECT_EQ(more.code, 0) << more.err;
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

}  // namespace
}  // namespace semfield
