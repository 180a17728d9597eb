// Loads the library of image_formats.h when it is first needed.
#include <atomic>

#include "core/error.h"
#include "formats/image_formats.h"
#include "system/shared_library.h"

namespace semfield {

#ifdef SEMFIELD_WITH_IMAGES

namespace {

std::atomic<bool> g_loaded{false};

const ImageFormats& load() {
  void* symbol = library_symbol(SEMFIELD_IMAGES_LIBRARY, kImageFormatsSymbol, "images other than PNG cannot be read",
                                "install Semfield again, or convert the images to PNG");
  g_loaded = true;
  return *reinterpret_cast<const ImageFormats* (*)()>(symbol)();
}

}  // namespace

bool images_available() { return true; }

bool image_formats_loaded() { return g_loaded; }

const ImageFormats& image_formats() {
  static const ImageFormats& formats = load();  // tried again where it failed
  return formats;
}

#else

bool images_available() { return false; }

bool image_formats_loaded() { return false; }

const ImageFormats& image_formats() {
  throw Error(ErrorKind::unavailable, "files.image.unsupported", "this build reads PNG images only",
              "build with -DSEMFIELD_WITH_IMAGES=ON, or pack the scene elsewhere");
}

#endif

}  // namespace semfield
