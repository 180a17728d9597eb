// Label files find the pictures that they are of, and no others: rigs of cameras, prefixes of tools, files of no frame.
#include "labels/frame_match.h"

#include "formats/image_io.h"
#include "formats/npz.h"
#include "loading/frame_masks.h"
#include "tests/labels/reader_case.h"

namespace semfield {
namespace {

using namespace testing_labels;
using testing_room::fresh_folder;

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
  std::string said() const {
    std::string out;
    for (const Diagnostic& d : found.all()) out += d.shown() + "\n";
    return out;
  }
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

TEST(FilesOfFrames, TheCameraMayBeToldAlone) {
  const FileCase c;
  for (const char* name : {"cam0/14.png", "cam1/14.png"}) c.put(name);
  Diagnostics found;
  EXPECT_EQ(c.read({frame_at("14", "/s/mav0/cam0/data/14.png"), frame_at("data_14", "/s/mav0/cam1/data/14.png")},
                   "{stem}.png", found),
            "14=cam0/14.png data_14=cam1/14.png ");
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
}

TEST(FilesOfFrames, ThoseOfNoFrameAreNamed) {
  const FileCase c;
  for (const char* name : {"a.png", "7d-b.png", "notes.txt"}) c.put(name);
  Diagnostics found;
  EXPECT_EQ(c.read({frame_at("a", "/s/a.jpg"), frame_at("b", "/s/b.jpg")}, "{name}.png", found), "a=a.png ");
  EXPECT_FINDING(found, "labels.frame.unmatched", "1 of 2 label files", "'7d-b.png', meant for frame 'b'?");
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

}  // namespace
}  // namespace semfield
