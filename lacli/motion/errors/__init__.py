"""What tracking errs by on a patient: noise, and the motion that it finds too little."""
