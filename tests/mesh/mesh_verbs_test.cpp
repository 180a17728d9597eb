// The program run with words, and a short run of a small scene that all tests of verbs share.

#include <fcntl.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <nlohmann/json.hpp>
#include <numeric>

#include "core/text.h"
#include "formats/image_io.h"
#include "formats/npz.h"
#include "loading/packed_scene.h"
#include "system/files.h"
#include "testkit/analytic_scene.h"
#include "tests/program.h"
#include "tests/session/train_testing.h"

namespace semfield::testing_verbs {
namespace {

using testing_program::Result;
using testing_program::succeeded;

// `path`: the PATH that it sees; "" leaves it. A hang is a failure, not a wait.
inline Result run(const TempDir& dir, const std::vector<std::string>& words, const std::string& path = "") {
  std::vector<std::string> environment;
  if (!path.empty()) environment.push_back("PATH=" + path);
  testing_program::Process process(testing_program::program(), words, dir.path(), environment);
  return process.wait_for(120).value_or(Result{});
}

inline std::vector<std::string> operator+(std::vector<std::string> words, const std::vector<std::string>& more) {
  words.insert(words.end(), more.begin(), more.end());
  return words;
}

inline std::string answer_of(const std::string& command) {
  std::string text;
  FILE* const pipe = popen(command.c_str(), "r");
  char buffer[256];
  while (std::fgets(buffer, sizeof buffer, pipe) != nullptr) text += buffer;
  pclose(pipe);
  return text;
}

inline bool found(const std::string& program) { return !answer_of("command -v " + program).empty(); }

// One short run for all tests.
class Verbs : public ::testing::Test {
 protected:
  static void SetUpTestSuite() {
    dir_ = new TempDir;
    const std::unique_ptr<Dataset> scene = testkit::make_analytic_scene();
    Diagnostics diagnostics;
    const SceneInfo info = scene->open(diagnostics);
    write_packed_scene(*dir_ / "room.sfpack", info,
                       [&](int frame, FrameBuffer& buffer) { scene->read(frame, buffer); });
    std::string yaml = testing_train::with_scene(testing_train::hash_config("report: {eval_every_s: 0, strips: 0}\n"),
                                                 "{type: packed, file: room.sfpack}");
    write_file_atomic(*dir_ / "config.yaml", yaml);
    const Result trained = succeeded(run(*dir_, {"train", *dir_ / "config.yaml", "--out", *dir_ / "run"}));
  }
  static void TearDownTestSuite() {
    delete dir_;
    dir_ = nullptr;
  }
  static std::string run_dir() { return *dir_ / "run"; }
  // What `semfield mesh RUN ... --json` says.
  static nlohmann::json mesh_json(const std::vector<std::string>& more, const std::string& of = run_dir()) {
    return nlohmann::json::parse(succeeded(run(*dir_, std::vector<std::string>{"mesh", of, "--json"} + more)).out);
  }
  static inline TempDir* dir_ = nullptr;
};

}  // namespace
}  // namespace semfield::testing_verbs

namespace semfield {
namespace {

// The program itself: `mesh` and `render --video` of a small run, read back by other programs.

namespace fs = std::filesystem;
using namespace testing_verbs;

TEST_F(Verbs, MeshWritesEveryFormatAndSaysSo) {
  const std::string stem = *dir_ / "out/room.v2";
  const Result r = succeeded(run(*dir_, {"mesh", run_dir(), "--resolution", "48", "--format", "ply,obj,glb", "--points",
                                         "--out", stem, "--json", "--faces", "3000", "--close-holes", "0.5"}));
  const nlohmann::json said = nlohmann::json::parse(r.out);
  EXPECT_GT(said["vertices"], 500);
  EXPECT_TRUE(said["faces"] > 1000 && said["faces"] <= 3000 && said["holes_closed"] > 0) << said;
  EXPECT_GE(said["components"], 1);
  EXPECT_GT(said["points"], 100);
  std::vector<std::string> files;
  for (const std::string colors : {"", "_classes"}) {
    for (const char* format : {".ply", ".obj", ".glb"}) files.push_back(stem + colors + format);
    files.push_back(stem + "_points" + colors + ".ply");
  }
  EXPECT_EQ(said["files"], files);
  for (const std::string& file : files) EXPECT_GT(fs::file_size(file), 1000U) << file;
  EXPECT_EQ(said["up"], (nlohmann::json{0.0, 0.0, 1.0}));
  EXPECT_HAS(r.err, "files show +z upright");
  EXPECT_HAS(read_text_file(stem + ".glb"), "KHR_materials_unlit");
  EXPECT_LACKS(read_text_file(stem + "_classes.glb"), "KHR_materials_unlit");
  EXPECT_TRUE(fs::exists(stem + ".mtl"));
  const std::string head = read_file_start(stem + ".ply", 400);
  EXPECT_HAS(head, "element vertex " + std::to_string(said["vertices"].get<int>()) + "\n", "property int label\n");
}

TEST_F(Verbs, MeshIsTheSameForAnyNumberOfThreadsAndItsDefaultsStandInTheRun) {
  const Result first = succeeded(run(*dir_, {"mesh", run_dir(), "--resolution", "32"}));
  EXPECT_EQ(first.out.find("mesh: vertices="), 0U) << first.out;
  EXPECT_HAS(first.out, " file=" + run_dir() + "/mesh.ply," + run_dir() + "/mesh_classes.ply\n");
  const Result second = succeeded(
      run(*dir_, {"mesh", run_dir(), "--resolution", "32", "--set", "runtime.threads=1", "--out", *dir_ / "one.ply"}));
  EXPECT_EQ(read_text_file(run_dir() + "/mesh.ply"), read_text_file(*dir_ / "one.ply"));
}

TEST_F(Verbs, MeshColorsAreThoseAskedFor) {
  const auto files = [&](const std::vector<std::string>& more, const std::string& of) {
    return mesh_json(std::vector<std::string>{"--resolution", "24"} + more, of)["files"]
        .get<std::vector<std::string>>();
  };
  using Files = std::vector<std::string>;
  const std::string out = *dir_ / "c.ply";
  EXPECT_EQ(files({"--color", "photo", "--out", out}, run_dir()), Files{out});
  const std::string photo = read_text_file(out);
  EXPECT_EQ(files({"--color", "class", "--out", out}, run_dir()), Files{out});
  const std::string classes = read_text_file(out);
  EXPECT_EQ(classes.size(), photo.size());
  EXPECT_NE(classes, photo);
  EXPECT_EQ(files({"--color", "both", "--out", out}, run_dir()), (Files{out, *dir_ / "c_classes.ply"}));
  EXPECT_EQ(read_text_file(out), photo);
  EXPECT_EQ(read_text_file(*dir_ / "c_classes.ply"), classes);
  // Without labels there is one colouring.
  std::string yaml = read_text_file(*dir_ / "config.yaml");
  yaml.replace(yaml.find("file: room.sfpack"), 17, "file: room.sfpack, labels: {frames: none}");
  write_file_atomic(*dir_ / "plain.yaml", yaml);
  const std::string plain = *dir_ / "plain";
  ASSERT_EQ(run(*dir_, {"train", *dir_ / "plain.yaml", "--steps", "200", "--out", plain}).code, 0);
  // So short a training may leave a fog around the cameras, of which none of them sees a face.
  EXPECT_EQ(files({"--keep-unseen"}, plain), Files{plain + "/mesh.ply"});
  for (const char* color : {"class", "both"}) {
    const Result r = run(*dir_, {"mesh", plain, "--color", color});
    EXPECT_EQ(r.code, 65) << r.err;
    EXPECT_HAS(r.err, "has no semantics; train with labels, or leave --color out");
  }
}

TEST_F(Verbs, MeshLeavesOutWhatNoCameraSeesUnlessTold) {
  const auto faces = [&](std::vector<std::string> more) {
    const std::vector<std::string> words{"mesh",   run_dir(), "--resolution",    "48", "--keep-components", "0",
                                         "--json", "--out",   *dir_ / "seen.ply"};
    const Result r = succeeded(run(*dir_, words + more));
    nlohmann::json said = nlohmann::json::parse(r.out);
    const bool told =
        r.err.find(" faces that no training camera sees are left out; --keep-unseen keeps them") != std::string::npos;
    EXPECT_EQ(told, said["unseen_faces"] > 0) << r.err;
    return std::pair(said["faces"].get<int>(), said["unseen_faces"].get<int>());
  };
  const auto [all, none] = faces({"--keep-unseen"});
  const auto [seen, unseen] = faces({"--surface", "density"});
  EXPECT_EQ(none, 0);
  EXPECT_GT(unseen, 0);
  EXPECT_EQ(seen + unseen, all);
}

// Of a room it is fused from depth, unless something asks for the density.
TEST_F(Verbs, MeshIsOfDepthWhereRaysEndInABackground) {
  const auto said = [&](const std::vector<std::string>& more) {
    return mesh_json(std::vector<std::string>{"--resolution", "40", "--out", *dir_ / "which.ply"} + more);
  };
  const nlohmann::json depth = said({}), density = said({"--level", "3"});
  EXPECT_EQ(depth["surface"], "depth");
  EXPECT_FALSE(depth.contains("level"));
  EXPECT_EQ(density["surface"], "density");
  EXPECT_EQ(density["level"], 3);
}

// Beside the fused depth images, and without touching what is written.
TEST_F(Verbs, MeshIsScoredAgainstDepthImages) {
  const std::string scored = *dir_ / "scored.ply", plain = *dir_ / "plain.ply";
  const std::vector<std::string> words{"mesh", run_dir(), "--resolution", "64", "--keep-components", "0", "--out"};
  const auto with = [&](const std::vector<std::string>& more) { return succeeded(run(*dir_, words + more)).out; };
  EXPECT_LACKS(with({plain}), "complete");
  EXPECT_HAS(with({scored, "--score"}), "mesh: complete ", "sensor: complete ", "\n  accurate ", "\nmesh: vertices=");
  EXPECT_EQ(read_text_file(scored), read_text_file(plain));
  const nlohmann::json of_run = nlohmann::json::parse(with({scored, "--score", "--json"}))["score"];
  EXPECT_EQ(of_run["distances"], (nlohmann::json{0.02, 0.05, 0.1}));
  EXPECT_GT(of_run["points"], of_run["held_out_points"]);
  EXPECT_GT(of_run["held_out_points"], 1000);
  for (const char* what : {"complete", "complete_of_held_out", "accurate", "f"}) {
    for (const char* of : {"mesh", "sensor"}) {
      const auto shares = of_run[of][what].get<std::vector<double>>();
      ASSERT_EQ(shares.size(), 3U) << of << what;
      EXPECT_TRUE(0 <= shares[0] && shares[0] <= shares[1] && shares[1] <= shares[2] && shares[2] <= 1) << of << what;
    }
    EXPECT_GT(of_run["sensor"][what][2], 0.95) << what << ": walls on the bounds are there";
    EXPECT_GT(of_run["sensor"][what][1], of_run["mesh"][what][1]) << what;
  }
  const nlohmann::json of_sensor = nlohmann::json::parse(with({scored, "--surface", "sensor", "--score", "--json"}));
  EXPECT_EQ(of_sensor["surface"], "sensor");
  EXPECT_EQ(of_sensor["score"]["mesh"], of_run["sensor"]) << "the same surface";
  EXPECT_TRUE(of_sensor["score"]["sensor"].is_null());
}

// A scene of another unit: what is a length without being asked for is a share of its longest side.
TEST_F(Verbs, LengthsThatNobodyNamesAreSharesOfALargeScene) {
  const std::string large = *dir_ / "large";
  const std::vector<std::string> scale{"--set", "scene.load.pose_scale=300", "--set", "scene.load.depth_scale=300"};
  const std::vector<std::string> train{"train", *dir_ / "config.yaml", "--out", large};
  ASSERT_EQ(run(*dir_, train + scale).code, 0);
  const nlohmann::json score = mesh_json({"--resolution", "48", "--score", "--out", *dir_ / "l.ply"}, large)["score"];
  const double metre = score["distances"][2].get<double>() / 0.1;
  EXPECT_GT(metre, 150) << "a fifth of the room's longest side";
  EXPECT_LT(metre, 600);
  EXPECT_NEAR(score["distances"][0].get<double>(), 0.02 * metre, 1e-9 * metre);
  EXPECT_GT(score["sensor"]["complete"][2], 0.9) << "the distances are those that are counted within";
  const Result map = succeeded(run(*dir_, {"mesh", large, "--format", "pgm", "--out", *dir_ / "l.pgm"}));
  char band[64];
  std::snprintf(band, sizeof band, "has what lies %.3g to %.3g above it", 0.1 * metre, metre);
  EXPECT_HAS(map.err, band);
}

TEST_F(Verbs, AMeshOfASceneWithoutDepthHasNoScore) {
  const std::unique_ptr<Dataset> scene = testkit::make_analytic_scene();
  Diagnostics diagnostics;
  const SceneInfo info = scene->open(diagnostics);
  PackOptions options;
  options.with_depth = false;
  write_packed_scene(
      *dir_ / "flat.sfpack", info, [&](int frame, FrameBuffer& buffer) { scene->read(frame, buffer); }, options);
  std::string yaml = read_text_file(*dir_ / "config.yaml");
  yaml.replace(yaml.find("room.sfpack"), 11, "flat.sfpack");
  write_file_atomic(*dir_ / "flat.yaml", yaml);
  ASSERT_EQ(run(*dir_, {"train", *dir_ / "flat.yaml", "--steps", "20", "--out", *dir_ / "flat"}).code, 0);
  for (const std::string more : {"--score", "--surface=sensor"}) {
    const Result r = run(*dir_, {"mesh", *dir_ / "flat", more, "--out", *dir_ / "none.ply"});
    EXPECT_EQ(r.code, 65) << r.err;
    EXPECT_HAS(r.err, "[mesh.depth.none]", *dir_ / "flat");
    EXPECT_FALSE(fs::exists(*dir_ / "none.ply"));
  }
}

TEST_F(Verbs, MeshIntoAFolderIsWrittenInIt) {
  const std::string there = *dir_ / "meshes";
  std::filesystem::create_directory(there);
  for (const std::string& out : {there, *dir_ / "new/"}) {
    const Result r = succeeded(run(*dir_, {"mesh", run_dir(), "--resolution", "24", "--out", out}));
    EXPECT_TRUE(std::filesystem::exists(std::filesystem::path(out) / "mesh.ply")) << r.out;
    EXPECT_FALSE(std::filesystem::exists(there + ".ply")) << "beside the folder";
  }
}

TEST_F(Verbs, MeshRefusesWhatMakesNoSense) {
  const auto refused = [&](std::vector<std::string> more, int code, const std::string& sentence) {
    const Result r = run(*dir_, std::vector<std::string>{"mesh", run_dir()} + more);
    EXPECT_EQ(r.code, code) << r.err;
    EXPECT_HAS(r.err, sentence);
  };
  refused({"--format", "gbl"}, 2, "did you mean glb?");
  refused({"--out", *dir_ / "mesh.stl"}, 2, "unknown mesh format 'stl'");
  refused({"--resolution", "8", "--voxel", "0.1"}, 2, "excludes");
  refused({"--voxel", "1e-7"}, 2, "choose a larger --voxel");
  refused({"--surface", "depth", "--level", "3"}, 2, "--level belongs to the surface of the density");
  refused({"--surface", "depth", "--keep-unseen"}, 2, "--keep-unseen belongs to the surface of the density");
  refused({"--band", "1,0.1", "--out", *dir_ / "x.pgm"}, 2, "--band 1,0.1: not two heights");
  refused({"--up", "w"}, 2, "[usage.value.invalid]");
  refused({"--resolution", "8", "--out", "/proc/none/x.ply"}, 73, "/proc/none: cannot create the folder");
}

TEST_F(Verbs, VideoIsDecodedByAnotherProgram) {
  if (!found("ffmpeg") || !found("ffprobe")) GTEST_SKIP() << "no ffmpeg here: no video was written";
  const std::string file = *dir_ / "a video: 1.mp4";
  const Result r = succeeded(run(*dir_, {"render", run_dir(), "--trajectory", "smooth", "--frames", "7", "--video",
                                         "--fps", "10", "--out", file}));
  EXPECT_HAS(r.out, "render: frames=7 ", "file=" + file);
  // Four panels of 48 x 36 pixels.
  EXPECT_EQ(answer_of("ffprobe -v error -count_frames -show_entries stream=width,height,nb_read_frames,r_frame_rate "
                      "-of csv=p=0 " +
                      shell_word("file:" + file)),
            "192,36,10/1,7\n");
  for (const fs::directory_entry& entry : fs::directory_iterator(dir_->path()))
    EXPECT_LACKS(entry.path().string(), ".part") << entry.path();
  // Its first panel is the rendered colour, within what the coding loses.
  const Result still = succeeded(
      run(*dir_, {"render", run_dir(), "--split", "test", "--video", "--panels", "rgb", "--out", *dir_ / "t.mkv"}));
  EXPECT_EQ(answer_of("ffprobe -v error -show_entries stream=width,height -of csv=p=0 " + shell_word(*dir_ / "t.mkv")),
            "48,36\n");
}

TEST_F(Verbs, PicturesHaveTheWidthThatIsAskedForAndOnesForTheEye) {
  const std::string folder = *dir_ / "narrow";
  const Result r = succeeded(run(*dir_, {"render", run_dir(), "--split", "test", "--width", "24", "--out", folder}));
  EXPECT_HAS(r.out, " size=24x18 ");
  std::map<std::string, int> kinds;
  for (const fs::directory_entry& entry : fs::directory_iterator(folder)) {
    if (entry.path().extension() != ".png") continue;
    const std::string name = entry.path().stem().string();
    ++kinds[name.substr(name.find("_", name.find_last_of("0123456789")) + 1)];
    const ImageSize size = image_size(entry.path().string());
    EXPECT_EQ(size.width_px, 24) << entry.path();
    EXPECT_EQ(size.height_px, 18) << entry.path();
  }
  const int frames = kinds["rgb"];
  EXPECT_GT(frames, 1);
  for (const char* kind : {"depth", "depth_vis", "label", "label_vis", "entropy", "entropy_vis"})
    EXPECT_EQ(kinds[kind], frames) << kind;
  if (!found("ffmpeg") || !found("ffprobe")) return;
  const std::string file = *dir_ / "narrow.mp4";
  const Result video = succeeded(run(*dir_, {"render", run_dir(), "--split", "test", "--video", "--width", "24",
                                             "--panels", "rgb,depth", "--out", file}));
  EXPECT_HAS(video.out, " size=48x18 ");
  EXPECT_EQ(answer_of("ffprobe -v error -show_entries stream=width,height -of csv=p=0 " + shell_word(file)), "48,18\n");
}

TEST_F(Verbs, VideoWithoutFfmpegNamesTheRemedy) {
  const Result r = run(*dir_, {"render", run_dir(), "--video"}, dir_->path());
  EXPECT_EQ(r.code, 69) << r.err;
  EXPECT_HAS(r.err, "ffmpeg is not in PATH; install it");
}

TEST_F(Verbs, VideoSurvivesAnFfmpegThatDies) {
  // One that ends at once, and one that reads all and then fails: neither hangs, kills us or leaves a file.
  int n = 0;
  for (const std::string script : {"#!/bin/sh\nexit 3\n", "#!/bin/sh\n/bin/cat >/dev/null\nexit 3\n"}) {
    const std::string folder = *dir_ / ("bin" + std::to_string(n++));
    fs::create_directory(folder);
    write_file_atomic(folder + "/ffmpeg", script);
    fs::permissions(folder + "/ffmpeg", fs::perms::owner_all);
    const std::string file = folder + "/out.mp4";
    const Result r =
        run(*dir_, {"render", run_dir(), "--trajectory", "smooth", "--frames", "40", "--video", "--out", file}, folder);
    EXPECT_EQ(r.code, 74) << r.err;
    EXPECT_HAS(r.err, "(exit code 3)");
    EXPECT_FALSE(fs::exists(file));
  }
}

// Disks of several sizes, so that it is full in the middle and at the end of the film: a film is whole or it is the old
// one.
TEST_F(Verbs, VideoOnAFullDiskKeepsTheOldFilm) {
  if (!found("ffmpeg")) GTEST_SKIP() << "no ffmpeg here: no video was written";
  const std::string disk = *dir_ / "disk", script = *dir_ / "full.sh";
  fs::create_directories(disk);
  if (std::system(("unshare -rm mount -t tmpfs tmpfs " + shell_word(disk) + " 2>/dev/null").c_str()) != 0)
    GTEST_SKIP() << "this system lets nobody mount a tmpfs in a namespace of its own";
  write_file_atomic(script,
                    "cd \"$(dirname \"$0\")\" || exit 98\n"
                    "mount -t tmpfs -o size=512k tmpfs disk || exit 99\n"
                    "printf 'an old film' >disk/room.mp4\n"
                    "for free in 0 4 8 12 400; do\n"
                    "  rm -f disk/other\n"
                    "  dd if=/dev/zero of=disk/other bs=1k count=$((508 - free)) 2>/dev/null\n"
                    "  " +
                        shell_word(SEMFIELD_BINARY) +
                        " render run --trajectory smooth --frames 30 --video --out disk/room.mp4 >said 2>err\n"
                        "  echo \"$free code $? $(grep -c 'an old film' disk/room.mp4) $(ls -A disk | wc -l)\" \\\n"
                        "    \"$(grep -c 'disk full: need .* have .*free some space or choose another disk' err)\"\n"
                        "done\n");
  // Exit code, the old film is there, two files in the folder, the cause is reported.
  EXPECT_EQ(answer_of("unshare -rm sh " + shell_word(script)),
            "0 code 74 1 2 1\n4 code 74 1 2 1\n8 code 74 1 2 1\n12 code 74 1 2 1\n400 code 0 0 2 0\n")
      << read_text_file(*dir_ / "err");
}

// Whoever may write in the folder could put links where a temporary file is expected.
TEST_F(Verbs, VideoFollowsNoLink) {
  if (!found("ffmpeg")) GTEST_SKIP() << "no ffmpeg here: no video was written";
  const std::string folder = *dir_ / "links", precious = *dir_ / "precious.txt";
  fs::create_directories(folder);
  write_file_atomic(precious, "mine");
  for (const char* name : {".room.part.mp4", ".room.mp4.0.tmp", "room.mp4"})
    fs::create_symlink(precious, fs::path(folder) / name);
  const Result r = succeeded(run(*dir_, {"render", run_dir(), "--trajectory", "smooth", "--frames", "3", "--video",
                                         "--out", folder + "/room.mp4"}));
  EXPECT_EQ(read_text_file(precious), "mine");
  EXPECT_FALSE(fs::is_symlink(folder + "/room.mp4"));
  EXPECT_GT(fs::file_size(folder + "/room.mp4"), 500U);
}

TEST_F(Verbs, VideoRefusesUnknownPanelsAndCounts) {
  if (!found("ffmpeg")) GTEST_SKIP() << "no ffmpeg here";
  const Result panel = run(*dir_, {"render", run_dir(), "--video", "--panels", "rgb,normals"});
  EXPECT_EQ(panel.code, 2);
  EXPECT_HAS(panel.err, "usage.value.invalid", "'normals'", "entropy");
  const Result ending = run(*dir_, {"render", run_dir(), "--video", "--out", *dir_ / "room.mpx"});
  EXPECT_EQ(ending.code, 2);
  EXPECT_HAS(ending.err, "'.mpx' is not the ending of a video file; name a file such as room.mp4; known: .mp4, ");
  EXPECT_EQ(run(*dir_, {"render", run_dir(), "--trajectory", "smooth", "--frames", "0"}).code, 2);
  EXPECT_EQ(run(*dir_, {"render", run_dir(), "--video", "--fps", "0"}).code, 2);
}

// Every file of a folder by name, as bytes.
std::map<std::string, std::string> files_of(const std::string& folder) {
  std::map<std::string, std::string> files;
  for (const fs::directory_entry& entry : fs::directory_iterator(folder))
    files[entry.path().filename().string()] = read_text_file(entry.path().string());
  return files;
}

TEST_F(Verbs, CamerasOfARenderRenderTheSameAgain) {
  const std::string first = *dir_ / "first", again = *dir_ / "again";
  ASSERT_EQ(run(*dir_, {"render", run_dir(), "--npy", "--out", first}).code, 0);
  const Result r =
      succeeded(run(*dir_, {"render", run_dir(), "--npy", "--trajectory", first + "/cameras.json", "--out", again}));
  const auto want = files_of(first);
  EXPECT_GT(want.size(), 7U);
  EXPECT_EQ(want, files_of(again));
  // A view of its own: another size, and rays that end before they meet anything.
  nlohmann::json set = nlohmann::json::parse(want.at("cameras.json"));
  nlohmann::json& view = set["cameras"][1];
  view.update({{"name", "own"}, {"width", 24}, {"cx", 12}, {"near", 1e-4}, {"far", 2e-4}});
  write_file_atomic(*dir_ / "edited.json", set.dump());
  const std::string edited = *dir_ / "edited";
  ASSERT_EQ(run(*dir_, {"render", run_dir(), "--npy", "--trajectory", *dir_ / "edited.json", "--out", edited}).code, 0);
  const NumpyArray depth =
      read_npy(edited + "/own_depth.npy", [](std::span<const std::int64_t> shape) { ASSERT_EQ(shape[1], 24); });
  EXPECT_LE(*std::max_element(depth.values.begin(), depth.values.end()), 2e-4F);
}

TEST_F(Verbs, ProbabilitiesOfViewsAreLabelsThatTrain) {
  const std::string out = *dir_ / "probable";
  const Result r = succeeded(run(*dir_, {"render", run_dir(), "--split", "train", "--probability", "--out", out}));
  const nlohmann::json order = nlohmann::json::parse(read_text_file(out + "/classes.json"));
  const nlohmann::json cameras = nlohmann::json::parse(read_text_file(out + "/cameras.json"))["cameras"];
  for (const nlohmann::json& camera : cameras) {
    const std::string base = out + "/" + camera["name"].get<std::string>();
    const NumpyArray p = read_npy(base + "_probability.npy", [&](std::span<const std::int64_t> shape) {
      const std::vector<std::int64_t> want{camera["height"], camera["width"], std::ssize(order)};
      ASSERT_EQ(std::vector<std::int64_t>(shape.begin(), shape.end()), want);
    });
    for (std::size_t i = 0; i < p.values.size(); i += order.size())
      ASSERT_NEAR(std::accumulate(&p.values[i], &p.values[i] + order.size(), 0.0), 1, 1e-5) << base;
  }
  std::string yaml = read_text_file(*dir_ / "config.yaml");
  yaml.replace(yaml.find("{type: packed, file: room.sfpack}"), 33,
               "{type: packed, file: room.sfpack, labels: {from: {type: npz, folder: probable, pattern: "
               "\"{name}_probability.npy\"}}}");
  write_file_atomic(*dir_ / "soft.yaml", yaml);
  const Result trained = succeeded(run(*dir_, {"train", *dir_ / "soft.yaml", "--steps", "2", "--out", *dir_ / "soft"}));
}

TEST_F(Verbs, ProbabilitiesTellTheirSizeBeforeTheyAreRendered) {
  const auto said_for = [&](int side) {
    const nlohmann::json camera{
        {"name", "wide"}, {"width", side},
        {"height", side}, {"fx", 900},
        {"fy", 900},      {"cx", 9},
        {"cy", 9},        {"world_from_camera", {{1, 0, 0, 0}, {0, 1, 0, 0}, {0, 0, 1, 0}, {0, 0, 0, 1}}}};
    write_file_atomic(*dir_ / "wide.json",
                      nlohmann::json{{"format", "semfield-cameras-1"}, {"cameras", {camera}}}.dump());
    const Result r = run(*dir_, {"render", run_dir(), "--probability", "--trajectory", *dir_ / "wide.json", "--out",
                                 "/proc/none/images"});
    EXPECT_EQ(r.code, 73) << r.err;
    return r.err;
  };
  // Four bytes for each of five classes.
  EXPECT_LACKS(said_for(1000), "probabilities of");
  const std::string large = said_for(16000);
  EXPECT_HAS(large, "probabilities of 1 view and 5 classes take 5.1 GB of disk");
}

TEST_F(Verbs, RenderRefusesWhatAVideoCannotHold) {
  for (const char* flag : {"--npy", "--probability"})
    EXPECT_EQ(run(*dir_, {"render", run_dir(), "--video", flag}).code, 2) << flag;
}

TEST_F(Verbs, SmoothPathRendersImagesToo) {
  const Result r = succeeded(run(*dir_, {"render", run_dir(), "--trajectory", "smooth", "--frames", "2"}));
  EXPECT_TRUE(fs::exists(run_dir() + "/render/smooth/00001_rgb.png"));
}

// The program itself: `mesh` in the forms of other programs, and `eval` by a published protocol.

TEST_F(Verbs, MeshWritesFilesForOtherPrograms) {
  const std::string stem = *dir_ / "other/room";
  const Result r = succeeded(run(*dir_, {"mesh", run_dir(), "--resolution", "32", "--format", "las,splats.ply,bt,pgm",
                                         "--band", "0.1,0.8", "--out", stem, "--json"}));
  const nlohmann::json said = nlohmann::json::parse(r.out);
  EXPECT_FALSE(said.contains("faces")) << "no surface is made for points";
  std::vector<std::string> files;
  for (const char* ending : {".las", ".splats.ply", ".bt", ".pgm", ".yaml"}) files.push_back(stem + ending);
  EXPECT_EQ(said["files"], files);
  EXPECT_HAS(r.err, "the floor is at ", " along +z");
  EXPECT_EQ(nlohmann::json::parse(read_text_file(stem + ".json"))["files"].size(), files.size());
  // The ending alone says so, and a page alone has no sidecar.
  const Result one =
      succeeded(run(*dir_, {"mesh", run_dir(), "--resolution", "24", "--out", *dir_ / "one.splats.ply"}));
  EXPECT_EQ(one.out, "mesh: file=" + *dir_ / "one.splats.ply" + "\n");
  const Result page = succeeded(run(*dir_, {"mesh", run_dir(), "--resolution", "24", "--out", *dir_ / "alone.html"}));
  EXPECT_FALSE(fs::exists(*dir_ / "alone.json"));
}

TEST_F(Verbs, EvalScoresByAProtocol) {
  const Result r = succeeded(run(*dir_, {"eval", run_dir(), "--protocol", "semantic_nerf", "--json"}));
  const nlohmann::json said = nlohmann::json::parse(r.out), of = said["protocol"];
  EXPECT_EQ(of["miou"], said["miou_present"]);
  EXPECT_EQ(of["total_accuracy"], said["total_accuracy"]);
  EXPECT_EQ(of["frames"].size(), said["frames"]);
  EXPECT_EQ(of["truth"].get<std::string>().size(), 8U);
  const Result shown = run(*dir_, {"eval", run_dir(), "--protocol", "panoptic_lifting"});
  EXPECT_HAS(shown.out, "protocol: name=panoptic_lifting miou=", " truth=" + of["truth"].get<std::string>());
  EXPECT_REFUSED(run(*dir_, {"eval", run_dir(), "--protocol", "semantic_nerf", "--split", "train"}), 2,
                 "eval.protocol.split", "--split");
}

}  // namespace
}  // namespace semfield
