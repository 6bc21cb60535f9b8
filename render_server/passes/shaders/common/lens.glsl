#pragma switch bool lens_bends   // the camera's picture is not a pinhole's
