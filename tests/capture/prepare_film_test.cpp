// `semfield prepare` of films and panoramas: what ffmpeg is given, with one that stands for it and with the true one.
#include <map>
#include <set>

#include "formats/image_io.h"
#include "tests/capture/prepare_case.h"

namespace semfield {
namespace {

using namespace testing_capture;

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
  const Result r = prepare("walk.mp4 --out scene --frames 6");
  EXPECT_EQ(r.code, 0) << r.err;
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
  const Result r = prepare("walk.mp4 --out scene --frames 600");
  EXPECT_EQ(r.code, 65) << r.err;
  EXPECT_SAID(r.err, "capture.poses.none", "the 3 photographs");
  EXPECT_HAS(read_text_file(home_ + "/scene/prepare/steps.json"), "the sharpest of each of 600 intervals");
}

TEST_F(PrepareFilm, AFullDiskIsNoBadFilm) {
  tool("ffmpeg", "#!/bin/sh\necho 'av_interleaved_write_frame(): No space left on device' >&2\nexit 1\n");
  const Result said = prepare("walk.mp4 --out scene");
  EXPECT_EQ(said.code, 74);
  EXPECT_SAID(said.err, "files.write.failed", "ffmpeg", "No space left on device");
  tool("ffmpeg", "#!/bin/sh\nexit 0\n");  // as it ends where the last of a file did not find room
  const Result unsaid = semfield_run("prepare walk.mp4 --out scene", home_,
                                     "ulimit -f 1000; PATH=" + shell_word(home_ + "/bin") + ":/usr/bin:/bin ");
  EXPECT_EQ(unsaid.code, 74);
  EXPECT_SAID(unsaid.err, "files.write.failed", "the limit of a file's size is reached");
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
  const Result r = prepare(shell_word("50%off %02d") + " --out " + shell_word("s%03d") + " --lens equirectangular");
  EXPECT_EQ(r.code, 65) << r.err;
  EXPECT_SAID(r.err, "capture.poses.none");
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
    const Result r = prepare(name + " --out scene_of_" + name + " --frames 6");
    EXPECT_EQ(r.code, 65) << r.out;
    EXPECT_SAID(r.err, "capture.video.format", name);
    EXPECT_FALSE(fs::exists(home_ + "/scene_of_" + name + "/images"));
  }
}

}  // namespace
}  // namespace semfield
